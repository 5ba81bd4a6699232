/* Tables that stay in flash memory on chips where that is another address space than RAM (AVR); elsewhere plain const data.
 *
 * FLASH_DATA goes to the definition.  Such data are read with flash_byte() and flash_copy() only: a pointer to them looks
 * like any other, and means something else.  (GCC's __flash qualifier would tell them apart; version 5.4 loses it in loops.)
 */
#ifndef FLASH_DATA_H
#define FLASH_DATA_H

#include <stdint.h>
#include <string.h>

#ifdef __AVR__
#include <avr/pgmspace.h>
#define FLASH_DATA PROGMEM
#else
#define FLASH_DATA
#endif

static inline uint8_t
flash_byte(const void *at)
{
#ifdef __AVR__
    return pgm_read_byte(at);
#else
    return *(const uint8_t *)at;
#endif
}

static inline void
flash_copy(void *to, const void *from, uint8_t size)
{
#ifdef __AVR__
    memcpy_P(to, from, size);
#else
    memcpy(to, from, size);
#endif
}

#endif
