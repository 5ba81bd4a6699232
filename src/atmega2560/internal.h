/* Shared by the files of the ATmega2560 port.  Who owns which peripheral: README.md. */
#ifndef ATMEGA2560_INTERNAL_H
#define ATMEGA2560_INTERNAL_H

#include <stdint.h>

/* gpio.c.  Numbers: port * 8 + bit, ports A to L without I. */
enum { PORT_A, PORT_B, PORT_C, PORT_D, PORT_E, PORT_F, PORT_G, PORT_H, PORT_J, PORT_K, PORT_L, PORT_COUNT };
#define PIN(port, bit) ((port) * 8 + (bit))

/* Does the chip have this pin, and is it not the console's? */
uint8_t pin_is_free(uint32_t pin);

void timer_start(void);    /* timer.c: Timer5 begins to count */
void console_start(void);  /* console.c: USART0 */

#endif
