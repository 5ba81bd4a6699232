/* Is the image in flash the one that was built?  scripts/seal_firmware.py puts the length and the checksum of all that comes
 * before it into the section .seal; here the chip's CRC unit computes it again (CRC-32, polynomial 0x04c11db7, start
 * 0xffffffff, words, nothing reversed). */
#include "internal.h"

struct seal {
    uint32_t magic, words, crc;
};

extern const uint32_t flash_start[] __asm__("vectors_start");
__attribute__((section(".seal"), used)) const volatile struct seal seal = { 0x46525354u /* "FRST" */, 0, 0 };

uint8_t
image_is_whole(void)
{
    uint32_t words = seal.words;
    RCC_AHBENR |= RCC_AHBENR_CRCEN;
    (void)RCC_AHBENR;
    CRC_CR = CRC_CR_RESET;
    for (const uint32_t *word = flash_start; words--; word++)
        CRC_DR = *word;
    return seal.words && CRC_DR == seal.crc;
}
