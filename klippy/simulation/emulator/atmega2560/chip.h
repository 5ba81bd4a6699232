/* What the files of the ATmega2560's emulator share.
 *
 * simavr supplies the processor: instructions and their cycles, memory, the order of interrupts.  The peripherals are
 * modelled here, after the datasheet, in place of simavr's own: exact to the cycle, and strict.
 * Time is counted in cycles since the chip last began to run; to the world outside in ticks of its clock.
 */
#ifndef EMULATOR_ATMEGA2560_CHIP_H
#define EMULATOR_ATMEGA2560_CHIP_H

#include <simavr/sim_avr.h>
#include <simavr/sim_cycle_timers.h>
#include <simavr/sim_interrupts.h>
#include <simavr/sim_io.h>
#include <stdint.h>

#include "emulator.h"

/* Addresses in data space, bits and vectors: ATmega2560 datasheet (2549Q), chapters 14 and 33. */
enum {
    REG_PINA = 0x20, REG_PINH = 0x100, REG_DDR = 1, REG_PORT = 2,
    REG_TIFR0 = 0x35, REG_TIFR5 = 0x3a, REG_TCCR0A = 0x44, REG_TCCR0B = 0x45, REG_OCR0A = 0x47, REG_OCR0B = 0x48,
    REG_SPCR = 0x4c, REG_SPSR = 0x4d, REG_SPDR = 0x4e, REG_ACSR = 0x50, REG_SMCR = 0x53, REG_MCUSR = 0x54,
    REG_RAMPZ = 0x5b, REG_EIND = 0x5c, REG_SPL = 0x5d, REG_SPH = 0x5e, REG_SREG = 0x5f, REG_WDTCSR = 0x60,
    REG_PRR0 = 0x64, REG_PRR1 = 0x65, REG_TIMSK5 = 0x73, REG_ADCL = 0x78, REG_ADCH = 0x79, REG_ADCSRA = 0x7a,
    REG_ADCSRB = 0x7b, REG_ADMUX = 0x7c, REG_DIDR2 = 0x7d, REG_DIDR0 = 0x7e, REG_TCCR1A = 0x80, REG_TCCR3A = 0x90,
    REG_TCCR4A = 0xa0, REG_TCCR2A = 0xb0, REG_OCR2A = 0xb3, REG_OCR2B = 0xb4, REG_UCSR0A = 0xc0, REG_UCSR0B = 0xc1,
    REG_TWBR = 0xb8, REG_TWSR = 0xb9, REG_TWDR = 0xbb, REG_TWCR = 0xbc, REG_UCSR0C = 0xc2, REG_UBRR0L = 0xc4, REG_UBRR0H = 0xc5, REG_UDR0 = 0xc6, REG_TCCR5A = 0x120, REG_TCCR5B = 0x121,
    REG_TCNT5L = 0x124, REG_TCNT5H = 0x125, REG_OCR5AL = 0x128, REG_OCR5AH = 0x129,
    REG_LAST = 0x137, RAM_START = 0x200, RAM_END = 0x21ff,
};
enum {
    VECTOR_SPI = 24, VECTOR_USART0_RX = 25, VECTOR_USART0_UDRE = 26, VECTOR_TIMER5_COMPA = 47, VECTOR_TIMER5_OVF = 50,
    VECTOR_COUNT = 57,
};
enum { CLOCK_HZ = 16000000, PIN_COUNT = 88 };

extern avr_t *chip;
extern struct sim_board board;
extern struct emulator_counters counters;

void chip_fault(const char *format, ...) __attribute__((format(printf, 1, 2)));
uint64_t chip_clock(void);              /* the present, in the world's count */

/* Registers.  A handler stores into chip->data what the register is to hold. */
typedef void (*write_fn)(uint16_t address, uint8_t value);
typedef uint8_t (*read_fn)(uint16_t address);
void on_write(uint16_t address, write_fn fn);
void on_read(uint16_t address, read_fn fn);
void write_plain(uint16_t address, uint8_t value);
/* Power reduction: fault if the peripheral of this bit is switched off (datasheet 11.10). */
void need_power(uint16_t prr, uint8_t bit, const char *name);

/* Interrupt requests.  A line asks as long as it is high; level() says whether it is, and is asked again when the
 * interrupt has been taken. */
void request(int vector, int (*level)(void), void (*taken)(void));
void request_check(int vector);         /* something that level() looks at has changed */

/* Something to be done `cycles` from now; 0 in fn's place of a time: no more.  One at a time for each fn. */
void after(uint64_t cycles, avr_cycle_timer_t fn);

void pins_reset(void);
void pins_init(void);
void pwm_init(void);
void pwm_reset(void);
void timer5_init(void);
void timer5_reset(void);
uint64_t timer5_zero(void);             /* a cycle at which the counter stood at 0 */
void usart_init(void);
void usart_reset(void);
void usart_receive(const uint8_t *data, uint32_t len);
void analog_init(void);
void analog_reset(void);
void spi_init(void);
void spi_reset(void);
void twi_init(void);
void twi_reset(void);
void watchdog_init(void);
void watchdog_reset(int by_watchdog);
void watchdog_fed(void);
void chip_watchdog_reset(void);         /* the watchdog has not been fed */

/* image.c */
const char *image_load(const char *path, uint8_t *flash, uint32_t flash_size);
int image_symbol(const char *name, uint32_t *value, uint32_t *size);

#endif
