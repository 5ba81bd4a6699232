/* Displays with an HD44780 on four data lines (data sheet: "Interfacing to the MPU", 4-bit operation).
 *
 *     RS, D7..D4  ══X══ upper half ═══X══ lower half ═══      RS: 0 command, 1 data
 *     E           _____/‾‾‾\__________/‾‾‾\_______________     taken at the falling edge; then delay_ticks
 *
 * The delay stands between the halves, too: while a chip still counts on eight lines, each half is a command to it.
 * A message keeps the task busy for two delays and 2 us a byte.
 */
#include "basecmd.h"
#include "board/delay.h"
#include "board/gpio.h"
#include "command.h"
#include "sched.h"

enum { DATA_LINES = 4, DATA_ARG = 3 };
enum { DELAY_MAX_US = 200 };  /* a longer wait would keep everything else waiting too */

struct hd44780 {
    struct gpio_out rs, e, data[DATA_LINES];
    uint32_t delay_ticks;
};

void
command_config_hd44780(const struct command_args *args)
{
    if (args->val[7] > timer_from_us(DELAY_MAX_US))
        shutdown(SHUTDOWN_LCD_DELAY);
    struct hd44780 set = { .delay_ticks = args->val[7] };
    set.rs = gpio_out_setup(args->val[1], 0);
    set.e = gpio_out_setup(args->val[2], 0);
    for (uint8_t line = 0; line < DATA_LINES; line++)
        set.data[line] = gpio_out_setup(args->val[DATA_ARG + line], 0);
    struct hd44780 *h = oid_alloc((uint8_t)args->val[0], command_config_hd44780, sizeof(*h));
    *h = set;
}
DECL_COMMAND(command_config_hd44780,
             "config_hd44780 oid=%c rs_pin=%u e_pin=%u d4_pin=%u d5_pin=%u d6_pin=%u d7_pin=%u delay_ticks=%u");

/* Data sheet, 2.7 V: set-up 60 ns, pulse 450 ns. */
static void
strobe(const struct hd44780 *h, uint8_t half)
{
    for (uint8_t line = 0; line < DATA_LINES; line++)
        gpio_out_write(h->data[line], half >> line & 1);
    gpio_out_write(h->e, 1);
    delay_ticks(timer_from_us(1));
    gpio_out_write(h->e, 0);
    delay_ticks(h->delay_ticks);
}

static void
send_message(const struct command_args *args, uint8_t is_data)
{
    const struct hd44780 *h = oid_lookup((uint8_t)args->val[0], command_config_hd44780);
    gpio_out_write(h->rs, is_data);
    for (uint8_t i = 0; i < args->data_len; i++) {
        strobe(h, args->data[i] >> 4);
        strobe(h, args->data[i] & 0x0f);
    }
}

void
command_hd44780_send_cmds(const struct command_args *args)
{
    send_message(args, 0);
}
DECL_COMMAND(command_hd44780_send_cmds, "hd44780_send_cmds oid=%c cmds=%*s");

void
command_hd44780_send_data(const struct command_args *args)
{
    send_message(args, 1);
}
DECL_COMMAND(command_hd44780_send_data, "hd44780_send_data oid=%c data=%*s");
