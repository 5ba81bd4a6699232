/* What the peripheral models of the STM32F334 share. Source of every register fact: RM0364, DS9994. */
#ifndef EMULATOR_STM32F334_H
#define EMULATOR_STM32F334_H

#include <stddef.h>

#include "../core.h"

/* A block of registers on a bus. `clock` is its enable bit in the RCC: register offset << 8 | bit; 0: always on. */
struct peripheral {
    const char *name;
    uint32_t base, size;
    uint16_t clock;
    uint32_t (*read)(unsigned unit, uint32_t offset);
    void (*write)(unsigned unit, uint32_t offset, uint32_t value);
    void (*reset)(unsigned unit);
    unsigned unit;
};

enum { RCC_AHBENR = 0x14, RCC_APB2ENR = 0x18, RCC_APB1ENR = 0x1c };
#define CLOCK_BIT(reg, bit) ((uint16_t)((reg) << 8 | (bit)))

enum {
    IRQ_PVD = 1, IRQ_EXTI0 = 6, IRQ_DMA1 = 11, IRQ_ADC = 18, IRQ_EXTI9_5 = 23, IRQ_TIM1_BRK_TIM15 = 24,
    IRQ_TIM1_UP_TIM16 = 25, IRQ_TIM1_TRG_TIM17 = 26, IRQ_TIM1_CC = 27, IRQ_TIM2 = 28, IRQ_TIM3 = 29,
    IRQ_I2C1_EV = 31, IRQ_I2C1_ER = 32, IRQ_SPI1 = 35, IRQ_USART1 = 37, IRQ_USART2 = 38, IRQ_USART3 = 39,
    IRQ_EXTI15_10 = 40, IRQ_TIM6 = 54, IRQ_TIM7 = 55, IRQ_HRTIM_MASTER = 67, IRQ_HRTIM_TIMA = 68, IRQ_HRTIM_FLT = 73,
};

/* Something outside or inside the chip that is broken on purpose (emulator_mutate). */
struct mutations {
    uint32_t no_crystal, no_pll, adc_uncalibrated, adc_dead, no_dll, fault_line, brown_out, clock_stuck, dma_dead,
        hrtim_dead, supply_dip, crystal_stops, hard_fault, compare_dead;
};
extern struct mutations mutation;

/* chip.c */
uint32_t unmodelled_read(const char *name, uint32_t offset);
void unmodelled_write(const char *name, uint32_t offset, uint32_t value);
void must_be(const char *name, const char *reg, uint32_t value, uint32_t allowed);

/* rcc.c */
void rcc_power_on(uint32_t cause);
void rcc_crystal_stops(void);
int rcc_enabled(uint16_t clock);
uint32_t rcc_read(unsigned unit, uint32_t offset);
void rcc_write(unsigned unit, uint32_t offset, uint32_t value);
uint32_t flash_read(unsigned unit, uint32_t offset);
void flash_write(unsigned unit, uint32_t offset, uint32_t value);
void flash_reset(unsigned unit);
struct clocks { uint32_t hclk, pclk1, pclk2, timer1, timer2, hrtim, adc_async, usart1; };
extern struct clocks clocks;
double ticks_of(uint32_t cycles, uint32_t hz); /* in ticks of CORE_TICK_HZ */

/* gpio.c */
uint32_t gpio_read(unsigned unit, uint32_t offset);
void gpio_write(unsigned unit, uint32_t offset, uint32_t value);
void gpio_reset(unsigned unit);
enum { MODE_INPUT, MODE_OUTPUT, MODE_ALTERNATE, MODE_ANALOG };
unsigned gpio_mode(unsigned pin);      /* pin = port * 16 + number */
unsigned gpio_function(unsigned pin);  /* alternate function, 99 if the pin is not in that mode */
unsigned gpio_pull(unsigned pin);      /* 0 none, 1 up, 2 down */
void gpio_drive(unsigned pin, int level); /* a peripheral's output on a pin in alternate mode */
int gpio_level(unsigned pin);          /* what the pin's input sees */

/* usart.c */
uint32_t usart_read(unsigned unit, uint32_t offset);
void usart_write(unsigned unit, uint32_t offset, uint32_t value);
void usart_reset(unsigned unit);
void usart_receive(const uint8_t *data, uint32_t length);
void usart_dma_enabled(unsigned channel);

/* dma.c */
uint32_t dma_read(unsigned unit, uint32_t offset);
void dma_write(unsigned unit, uint32_t offset, uint32_t value);
void dma_reset(unsigned unit);
int dma_request(unsigned channel);     /* one transfer; 0 if the channel was ready for it */
int dma_enabled(unsigned channel);
uint32_t dma_peripheral_address(unsigned channel);
uint32_t dma_until_notice(unsigned channel); /* transfers until its next half or end */
void dma_block(unsigned channel, const uint16_t *data, uint32_t count); /* transfers from one peripheral register */

/* adc.c */
uint32_t adc_read_register(unsigned unit, uint32_t offset);
void adc_write_register(unsigned unit, uint32_t offset, uint32_t value);
void adc_reset(unsigned unit);
void adc_before_change(void);          /* the bridge is about to change: samples before now are taken first */
void adc_trigger_changed(void);        /* HRTIM or the converter has been set up differently */
void adc_dma_changed(void);
void adc_sync(void);

/* hrtim.c */
uint32_t hrtim_read(unsigned unit, uint32_t offset);
void hrtim_write(unsigned unit, uint32_t offset, uint32_t value);
void hrtim_reset(unsigned unit);
/* ADC trigger 1 or 3: 1 if it comes once a period, with that period and the clock of one of its instants. */
int hrtim_adc_trigger(unsigned number, uint32_t *period_ticks, uint64_t *phase_clock);
void hrtim_fault_line(void);           /* the level of a fault input may have changed */
int hrtim_is_fault_input(unsigned pin); /* set up as one: the driver's line goes there */
void hrtim_system_fault(void);         /* the clock security has found the crystal dead */
int hrtim_peek(const char *what, uint32_t *value);

/* timer.c */
uint32_t timer_read(unsigned unit, uint32_t offset);
void timer_write(unsigned unit, uint32_t offset, uint32_t value);
void timer_reset(unsigned unit);
void timer_before_clock_change(void);
void timer_pin_changed(unsigned pin);  /* put into or out of alternate mode */

/* bus.c: SPI and I2C */
uint32_t spi_read(unsigned unit, uint32_t offset);
void spi_write(unsigned unit, uint32_t offset, uint32_t value);
void spi_reset(unsigned unit);
uint32_t i2c_read(unsigned unit, uint32_t offset);
void i2c_write(unsigned unit, uint32_t offset, uint32_t value);
void i2c_reset(unsigned unit);

/* small.c: PWR, IWDG, CRC, SYSCFG, EXTI, DBGMCU */
#define DECLARE_PERIPHERAL(p) \
    uint32_t p##_read(unsigned unit, uint32_t offset); \
    void p##_write(unsigned unit, uint32_t offset, uint32_t value); \
    void p##_reset(unsigned unit)
DECLARE_PERIPHERAL(pwr);
DECLARE_PERIPHERAL(iwdg);
DECLARE_PERIPHERAL(crc);
DECLARE_PERIPHERAL(syscfg);
DECLARE_PERIPHERAL(exti);
DECLARE_PERIPHERAL(dbgmcu);
uint32_t syscfg_remap(void);           /* SYSCFG_CFGR1 */
int pwr_system_fault(void);             /* low supply voltage is wired to the timers (PVD_LOCK) */
uint32_t syscfg_remap3(void);          /* SYSCFG_CFGR3 */

#endif
