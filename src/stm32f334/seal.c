/* The chip's CRC unit: is the image in flash the one that was built, and are a message's bytes those that were sent?
 *
 * The image:  scripts/build/seal_firmware.py puts the length and the checksum of all that comes
 * before it into the section .seal; here it is computed again (CRC-32, polynomial 0x04c11db7, start 0xffffffff, words, nothing
 * reversed).  At boot, before the other use begins.
 *
 * Messages (wire.h): CRC-16, polynomial 0x1021, start 0xffff, the bits of each byte and of the result reversed.  The unit
 * takes a word's highest byte first.  Tasks only.
 */
#include "internal.h"
#include "wire.h"

struct seal {
    uint32_t magic, words, crc;
};

extern const uint32_t flash_start[] __asm__("vectors_start");
__attribute__((section(".seal"), used)) const volatile struct seal seal = { 0x46525354u /* "FRST" */, 0, 0 };

uint8_t
image_is_whole(void)
{
    uint32_t words = seal.words;
    CRC_CR = CRC_CR_RESET;
    for (const uint32_t *word = flash_start; words--; word++)
        CRC_DR = *word;
    return seal.words && CRC_DR == seal.crc;
}

enum { POLYNOMIAL_16_BIT = 1, REVERSE_BYTES = 1 };

void
message_crc_start(void)
{
    CRC_INIT = 0xffff;
    CRC_POL = 0x1021;
}

uint16_t
wire_crc16(const uint8_t *data, uint8_t len)
{
    CRC_CR = CRC_CR_RESET | CRC_CR_POLYSIZE(POLYNOMIAL_16_BIT) | CRC_CR_REV_IN(REVERSE_BYTES) | CRC_CR_REV_OUT;
    for (; len >= 4; len -= 4, data += 4)
        CRC_DR = __builtin_bswap32(((const struct unaligned *)data)->word);
    while (len--)
        R8(CRC_BASE, 0x00) = *data++ /* CRC_DR: eight bits in are eight bits of input */;
    return (uint16_t)CRC_DR;
}
