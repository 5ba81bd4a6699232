/* Tables that stay in flash memory on chips where that is another address space than RAM (AVR); elsewhere plain const data.
 *
 * FLASH_DATA goes to the definition.  Such data are read with flash_byte() and flash_copy() only: a pointer to them looks
 * like any other, and means something else.  (GCC's __flash qualifier would keep them apart; version 5.4 loses it in loops.)
 * A port with such a memory defines PORT_FLASH_DATA in its port_types.h, and there the three.
 */
#ifndef FLASH_DATA_H
#define FLASH_DATA_H

#include <stdint.h>
#include <string.h>

#include "port_types.h"

#ifndef PORT_FLASH_DATA
#define FLASH_DATA

static inline uint8_t
flash_byte(const void *at)
{
    return *(const uint8_t *)at;
}

static inline void
flash_copy(void *to, const void *from, uint8_t size)
{
    memcpy(to, from, size);
}
#endif

#endif
