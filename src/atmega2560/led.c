/* LED chains: eight bits of wave by instructions of known length (16 MHz: 62.5 ns a cycle).
 *
 *     0:  ‾‾‾‾‾\____________    high 5 cycles, 312 ns        (WS2812B: 250..550, SK6812: 150..450)
 *     1:  ‾‾‾‾‾‾‾‾‾‾‾\______    high 11 cycles, 688 ns       (WS2812B: 650..950, SK6812: 450..750)
 *
 * What comes between two bits takes some 30 cycles, 2 us: longer than the low part must be, shorter than what LEDs take
 * for the end.  An interrupt of more than bit_max_ticks in between ends the transmission; the host repeats it.
 */
#include "board/gpio.h"
#include "board/irq.h"
#include "board/led.h"
#include "internal.h"

enum { PORT = 2 };

/* The store takes effect in its second cycle, so from the first store's end to the next one's end: 2 cycles waited, 1 for sbrs
 * and 2 for the store of a 0; for a 1 sbrs takes 2 and skips that store, then 5 and 2 for the last one. */
static inline void
pulse(volatile uint8_t *port, uint8_t high, uint8_t low, uint8_t bits)
{
    __asm__ volatile("st %a[port], %[high]\n\t"
                     "rjmp .+0\n\t"
                     "sbrs %[bits], 7\n\t"
                     "st %a[port], %[low]\n\t"
                     "rjmp .+0\n\t"
                     "rjmp .+0\n\t"
                     "nop\n\t"
                     "st %a[port], %[low]"
                     :
                     : [port] "z"(port), [high] "r"(high), [low] "r"(low), [bits] "r"(bits)
                     : "memory");
}

uint8_t
led_send(struct gpio_out pin, const uint8_t *data, uint16_t size, uint32_t bit_max_ticks)
{
    volatile uint8_t *port = pin.regs + PORT;
    const uint8_t mask = pin.mask;
    const uint16_t limit = bit_max_ticks > 0x7fff ? 0x7fff : (uint16_t)bit_max_ticks;
    irqstatus_t flag = irq_save();
    uint16_t low_since = TCNT5;
    irq_restore(flag);
    for (; size; size--, data++)
        for (uint8_t bits = *data, left = 8; left; left--, bits = (uint8_t)(bits << 1)) {
            flag = irq_save();
            if ((uint16_t)(TCNT5 - low_since) >= limit) {
                irq_restore(flag);
                return 0;
            }
            uint8_t now = *port;  /* its other bits may change whenever interrupts are allowed */
            pulse(port, now | mask, now & (uint8_t)~mask, bits);
            low_since = TCNT5;
            irq_restore(flag);
        }
    return 1;
}
