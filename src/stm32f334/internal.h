/* Shared by the files of the STM32F334 port.  Who owns which peripheral: README.md. */
#ifndef STM32F334_INTERNAL_H
#define STM32F334_INTERNAL_H

#include <stdint.h>

#include "regs.h"
#include "shutdown_reasons.h"

/* boot.c: what the chip was found like.  Bits of boot_findings(). */
enum boot_finding {
    BOOT_NO_CLOCK = 1 << 0,    /* the crystal or the PLL did not start, or a clock switch does not read back */
    BOOT_BROWN_OUT = 1 << 1,   /* the last reset was a dip of the supply, or it is too low now */
    BOOT_BAD_FLASH = 1 << 2,   /* the image's checksum is wrong */
};
uint8_t boot_findings(void);
uint8_t clock_start(void);     /* clock.c: 1 if the chip runs at 72 MHz from its crystal */
uint8_t clock_verify(void);    /* is it still so, by the registers? */
uint8_t peripherals_start(void);     /* clock.c: on with the clocks that always run; 1 if all of them are */
uint8_t peripherals_verify(void);    /* are they still? */
uint8_t peripherals_can_talk(void);  /* at least those without which no report can be sent */
uint8_t supervision_runs(void);      /* voltage detector and its way to the bridge */
uint32_t clock_hz(void);       /* of processor and timers, whatever was found */
uint8_t supply_is_low(void);
uint8_t image_is_whole(void);  /* seal.c */
void message_crc_start(void);  /* seal.c: wire_crc16() works from then on */
_Noreturn void enter_rom_bootloader(void);

/* A word at any address. */
struct unaligned {
    uint32_t word;
} __attribute__((packed, may_alias));

/* gpio.c.  Numbers: port * 16 + bit. */
enum { PIN_A = 0, PIN_B = 16, PIN_C = 32, PIN_D = 48, PIN_F = 80, PIN_COUNT = 96 };
enum pin_mode { PIN_INPUT, PIN_OUTPUT, PIN_ALTERNATE, PIN_ANALOG };
uint8_t pin_exists(uint32_t pin);
/* Pins that belong to the console, the debugger, the crystal or the bridge are not for anybody else. */
uint8_t pin_is_free(uint32_t pin);
void pin_set_mode(uint32_t pin, enum pin_mode mode);
void pin_set_pull(uint32_t pin, int8_t pull);
void pin_set_function(uint32_t pin, uint8_t function); /* alternate function, fast edges */
void pin_set_open_drain(uint32_t pin);
uint8_t pin_level(uint32_t pin);

/* bridge.c */
void bridge_move_sampling(uint16_t ticks);
uint32_t bridge_period_ticks(void);
uint32_t bridge_ticks_to_edge(void);
uint32_t bridge_next_edge(void);
void bridge_stop(void);
/* sync_adc.c: SHUTDOWN_NONE, or why the bridge must not run on its samples. */
enum shutdown_reason sync_adc_objection(void);

/* adc.c: bring a converter up (ADC1_BASE, ADC2_BASE); 0 if it cannot be calibrated or does not get ready. */
uint8_t adc_bring_up(uint32_t adc);
uint8_t adc_is_up(uint32_t adc);
void adc_set_channel(uint32_t adc, uint8_t channel, uint8_t sampling);

/* Interrupts all keep the priority they have after reset: they never preempt each other. */
static inline void
irq_allow(unsigned irq)
{
    NVIC_ISER(irq / 32) = BIT(irq % 32);
}

#endif
