/* LED chains with one data line (WS2812, SK6812): the line's wave is made by hand.
 *
 *     0:  ‾‾‾\_________    high HIGH_0_NS          1:  ‾‾‾‾‾‾‾\_____    high HIGH_1_NS
 *     latch: low for reset_min_ticks
 *
 * Only the high part of a bit must be exact (a 0 held too long is a 1), so interrupts are off just then.  The low part may
 * stretch, but not to bit_max_ticks: the LEDs would take that for the latch.  If an interrupt stretched it so, the
 * transmission is given up and neopixel_result says success=0; the host sends again.
 *
 * Worst time with interrupts off: one bit's high part, about 1 us.  A chain of 100 LEDs keeps the task busy for 3 ms.
 */
#include <string.h>

#include "basecmd.h"
#include "board/delay.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/led.h"
#include "command.h"
#include "sched.h"

DECL_RESPONSE(response_neopixel, "neopixel_result oid=%c success=%c");

/* WS2812B data sheet: T0H 250..550 ns, T1H 650..950 ns, T0L/T1L from 450 ns on. */
enum { HIGH_0_NS = 300, HIGH_1_NS = 750, LOW_NS = 450 };
enum { DATA_SIZE_MAX = 0x7fff, RESET_MAX_US = 2000 };  /* a longer wait would keep everything else waiting too */

struct neopixel {
    struct gpio_out pin;
    uint32_t bit_max_ticks, reset_min_ticks;
    uint32_t sent_clock;   /* end of the last transmission */
    uint16_t data_size;
    uint8_t data[];
};

void
command_config_neopixel(const struct command_args *args)
{
    uint32_t data_size = args->val[2];
    if (!data_size || data_size > DATA_SIZE_MAX || args->val[4] > timer_from_us(RESET_MAX_US))
        shutdown(SHUTDOWN_NEOPIXEL_SIZE);
    uint16_t size = (uint16_t)(sizeof(struct neopixel) + data_size);
    struct gpio_out pin = gpio_out_setup(args->val[1], 0);
    struct neopixel *n = oid_alloc((uint8_t)args->val[0], command_config_neopixel, size);
    n->pin = pin;
    n->data_size = (uint16_t)data_size;
    n->bit_max_ticks = args->val[3];
    n->reset_min_ticks = args->val[4];
    n->sent_clock = timer_read_time();
}
DECL_COMMAND(command_config_neopixel,
             "config_neopixel oid=%c pin=%u data_size=%hu bit_max_ticks=%u reset_min_ticks=%u");

static struct neopixel *
neopixel_lookup(const struct command_args *args)
{
    return oid_lookup((uint8_t)args->val[0], command_config_neopixel);
}

void
command_neopixel_update(const struct command_args *args)
{
    struct neopixel *n = neopixel_lookup(args);
    uint32_t pos = args->val[1];
    if (pos > n->data_size || args->data_len > n->data_size - pos)
        shutdown(SHUTDOWN_NEOPIXEL_UPDATE);
    memcpy(&n->data[pos], args->data, args->data_len);
}
DECL_COMMAND(command_neopixel_update, "neopixel_update oid=%c pos=%hu data=%*s");

#ifdef PORT_LED_CHAIN
static uint8_t
send_bits(const struct neopixel *n)
{
    return led_send(n->pin, n->data, n->data_size, n->bit_max_ticks);
}
#else
/* Rounded down: calls add to it. */
static uint32_t
ticks_of_ns(uint32_t ns)
{
    return PORT_CLOCK_HZ / 1000000u * ns / 1000u;
}

/* Returns 0 if the low time before this bit was too long. */
static uint8_t
send_bit(const struct neopixel *n, uint8_t bit, uint32_t *low_since)
{
    irqstatus_t flag = irq_save();
    uint32_t low_ticks = timer_read_time() - *low_since;
    if (low_ticks >= n->bit_max_ticks) {
        irq_restore(flag);
        return 0;
    }
    gpio_out_write(n->pin, 1);
    delay_ticks(ticks_of_ns(bit ? HIGH_1_NS : HIGH_0_NS));
    gpio_out_write(n->pin, 0);
    irq_restore(flag);
    *low_since = timer_read_time();
    delay_ticks(ticks_of_ns(LOW_NS));
    return 1;
}

static uint8_t
send_bits(const struct neopixel *n)
{
    uint32_t low_since = timer_read_time();
    for (uint16_t i = 0; i < n->data_size; i++)
        for (uint8_t bit = 0, byte = n->data[i]; bit < 8; bit++, byte = (uint8_t)(byte << 1))
            if (!send_bit(n, byte >> 7, &low_since))
                return 0;
    return 1;
}
#endif

static uint8_t
send_all(const struct neopixel *n)
{
    uint32_t rested_ticks = timer_read_time() - n->sent_clock;
    if (rested_ticks < n->reset_min_ticks)
        delay_ticks(n->reset_min_ticks - rested_ticks);
    return send_bits(n);
}

void
command_neopixel_send(const struct command_args *args)
{
    struct neopixel *n = neopixel_lookup(args);
    uint8_t success = send_all(n);
    n->sent_clock = timer_read_time();
    respond(&response_neopixel, (uint8_t)args->val[0], success);
}
DECL_COMMAND(command_neopixel_send, "neopixel_send oid=%c");
