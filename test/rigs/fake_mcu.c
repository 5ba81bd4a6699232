/* A stand-in for libferrite_mcu.so: obeys one-byte orders from its line, so that a test can work pins at known times.
 *
 *   'w' pin value   write pin          'p' pin value   hardware PWM, value of 255
 *   'r' pin         read pin → 1 byte  'a' pin         ADC → 2 bytes, low first
 *   'b' lo hi       bridge phase       's' count       samples of the last `count` periods → 2 bytes each
 *   'c'             clock → 8 bytes    'R'             ask for a reset; boot sends 'B'
 */
#include "sim_mcu.h"

static const struct sim_board *board;
static struct sim_board copy;
static uint64_t now, due = UINT64_MAX;
static uint8_t input[4096];
static uint32_t filled;
static int reset;

void sim_mcu_boot(const struct sim_board *b, uint64_t clock)
{
    copy = *b;
    board = &copy;
    now = clock;
    filled = 0;
    board->console_send(board->ctx, (const uint8_t *)"B", 1, clock);
}

uint64_t sim_mcu_next_event(void)
{
    return due;
}

static void reply(const void *data, uint32_t length)
{
    board->console_send(board->ctx, data, length, now);
}

static void samples(uint8_t count)
{
    uint16_t codes[256];
    board->sync_adc_read(board->ctx, codes, count, now - 600u * count, 600);
    reply(codes, 2u * count);
}

static uint32_t obey(const uint8_t *o)
{
    uint8_t level;
    uint16_t code;
    switch (o[0]) {
    case 'w': board->pin_write(board->ctx, o[1], o[2], now); return 3;
    case 'p': board->pwm_write(board->ctx, o[1], 7200, o[2], now); return 3;
    case 'r': level = board->pin_read(board->ctx, o[1], now); reply(&level, 1); return 2;
    case 'a': code = board->adc_read(board->ctx, o[1], now); reply(&code, 2); return 2;
    case 'b': board->bridge_set(board->ctx, (uint16_t)(o[1] | o[2] << 8), now); return 3;
    case 's': samples(o[1]); return 2;
    case 'c': reply(&now, 8); return 1;
    case 'R': reset = 1; return 1;
    default: return 1;
    }
}

void sim_mcu_advance(uint64_t clock)
{
    if (clock > now)
        now = clock;
    for (uint32_t at = 0; at < filled;)
        at += obey(input + at);
    filled = 0;
    due = UINT64_MAX;
}

void sim_mcu_receive(const uint8_t *data, uint32_t len)
{
    for (uint32_t i = 0; i < len && filled < sizeof input; i++)
        input[filled++] = data[i];
    due = now;
}

int sim_mcu_take_reset(void)
{
    int asked = reset;
    reset = 0;
    return asked;
}
