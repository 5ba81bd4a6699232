/* Displays with an ST7920 on its serial interface (data sheet: "Serial interface").
 *
 *     CS   __/‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾\__     high during a message
 *     SID    11111 0 RS 0 │ D7..D4 0000 │ D3..D0 0000 │ ...      taken at the rising edge of SCLK
 *            sync byte      one byte, then its execution time
 *
 * A message keeps the task busy for sync_delay_ticks, and for cmd_delay_ticks and 24 bits of 0.6 us a byte.
 */
#include "basecmd.h"
#include "board/delay.h"
#include "board/gpio.h"
#include "command.h"
#include "sched.h"

enum { SYNC_COMMAND = 0xf8, SYNC_DATA = 0xfa };
enum { HALF_CLOCK_NS = 300 };  /* data sheet, 2.7 V: high and low from 300 ns on */
enum { DELAY_MAX_US = 200 };   /* a longer wait would keep everything else waiting too */

struct st7920 {
    struct gpio_out cs, sclk, sid;
    uint32_t sync_delay_ticks, cmd_delay_ticks;
};

void
command_config_st7920(const struct command_args *args)
{
    if (args->val[4] > timer_from_us(DELAY_MAX_US) || args->val[5] > timer_from_us(DELAY_MAX_US))
        shutdown(SHUTDOWN_LCD_DELAY);
    struct gpio_out cs = gpio_out_setup(args->val[1], 0);
    struct gpio_out sclk = gpio_out_setup(args->val[2], 0);
    struct gpio_out sid = gpio_out_setup(args->val[3], 0);
    struct st7920 *s = oid_alloc((uint8_t)args->val[0], command_config_st7920, sizeof(*s));
    *s = (struct st7920){ cs, sclk, sid, args->val[4], args->val[5] };
}
DECL_COMMAND(command_config_st7920,
             "config_st7920 oid=%c cs_pin=%u sclk_pin=%u sid_pin=%u sync_delay_ticks=%u cmd_delay_ticks=%u");

static void
clock_out(const struct st7920 *s, uint8_t byte)
{
    const uint32_t half_ticks = PORT_CLOCK_HZ / 1000000u * HALF_CLOCK_NS / 1000u + 1;
    for (uint8_t bit = 0; bit < 8; bit++, byte = (uint8_t)(byte << 1)) {
        gpio_out_write(s->sid, byte >> 7);
        delay_ticks(half_ticks);
        gpio_out_write(s->sclk, 1);
        delay_ticks(half_ticks);
        gpio_out_write(s->sclk, 0);
    }
}

static void
send_message(const struct command_args *args, uint8_t sync)
{
    const struct st7920 *s = oid_lookup((uint8_t)args->val[0], command_config_st7920);
    gpio_out_write(s->cs, 1);
    clock_out(s, sync);
    delay_ticks(s->sync_delay_ticks);
    for (uint8_t i = 0; i < args->data_len; i++) {
        clock_out(s, args->data[i] & 0xf0);
        clock_out(s, (uint8_t)(args->data[i] << 4));
        delay_ticks(s->cmd_delay_ticks);
    }
    gpio_out_write(s->cs, 0);
}

void
command_st7920_send_cmds(const struct command_args *args)
{
    send_message(args, SYNC_COMMAND);
}
DECL_COMMAND(command_st7920_send_cmds, "st7920_send_cmds oid=%c cmds=%*s");

void
command_st7920_send_data(const struct command_args *args)
{
    send_message(args, SYNC_DATA);
}
DECL_COMMAND(command_st7920_send_data, "st7920_send_data oid=%c data=%*s");
