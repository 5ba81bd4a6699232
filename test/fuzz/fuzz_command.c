/* libFuzzer target: bytes from a hostile host into the whole simulated MCU.
 *
 * The input is a script of steps, each led by one byte:
 *   0x00..0x7f   raw bytes follow (that many): straight into the receiver
 *   0x80..0xbf   content bytes follow (low six bits): wrapped into a sound block with the right sequence number, so
 *                that the fuzzer reaches the commands without guessing checksums
 *   0xc0..0xff   time passes: 2^(low five bits) ticks, at most 2^19; 2^20 for one input, because objects may be configured to
 *                look at something every tick
 *
 * What must hold, besides the sanitizers: every block sent is sound, and time never stands still.
 */
#include <stdlib.h>
#include <string.h>

#include "sim_mcu.h"
#include "wire.h"

static uint64_t now;
static uint8_t expected_sequence;
static uint32_t noise;

enum { WAVE_TICKS_MAX = 72000000 };

static void
require(int condition)
{
    if (!condition)
        abort();
}

static void
pin_write(void *ctx, uint32_t pin, uint8_t value, uint64_t clock)
{
    (void)ctx;
    /* waves made by hand run ahead of the present, by what their task waits */
    require(pin < 128 && value <= 1 && clock <= now + WAVE_TICKS_MAX);
}

static uint8_t
pin_read(void *ctx, uint32_t pin, uint64_t clock)
{
    (void)ctx, (void)pin, (void)clock;
    noise = noise * 1664525u + 1013904223u;
    return noise >> 31;
}

static void
pwm_write(void *ctx, uint32_t pin, uint32_t cycle_ticks, uint32_t value, uint64_t clock)
{
    (void)ctx, (void)cycle_ticks;
    require(pin < 128 && value <= 255 && clock <= now);
}

static uint16_t
adc_read(void *ctx, uint32_t pin, uint64_t clock)
{
    (void)ctx, (void)pin, (void)clock;
    noise = noise * 1664525u + 1013904223u;
    return noise >> 20;
}

static void
bridge_set(void *ctx, uint16_t phase, uint64_t clock)
{
    (void)ctx;
    require(phase <= 45000 && clock <= now);
}

static void
sync_adc_read(void *ctx, uint16_t *samples, uint32_t count, uint64_t first_clock, uint32_t period_ticks)
{
    (void)ctx;
    require(count && first_clock + (uint64_t)(count - 1) * period_ticks <= now);
    for (uint32_t i = 0; i < count; i++)
        samples[i] = (uint16_t)(1000 + i);
}

static void
console_send(void *ctx, const uint8_t *data, uint32_t len, uint64_t clock)
{
    (void)ctx;
    require(clock <= now && len >= BLOCK_SIZE_MIN && len <= BLOCK_SIZE_MAX && data[0] == len);
    uint16_t crc = wire_crc16(data, (uint8_t)(len - BLOCK_TRAILER_SIZE));
    require(data[len - 3] == crc >> 8 && data[len - 2] == (crc & 0xff) && data[len - 1] == BLOCK_SYNC);
    expected_sequence = data[1] & BLOCK_SEQ_MASK;
}

static const struct sim_board board = {
    .pin_write = pin_write,
    .pin_read = pin_read,
    .pwm_write = pwm_write,
    .adc_read = adc_read,
    .bridge_set = bridge_set,
    .sync_adc_read = sync_adc_read,
    .console_send = console_send,
};

static void
send_sound_block(const uint8_t *content, uint8_t len)
{
    uint8_t block[BLOCK_SIZE_MAX];
    if (len > BLOCK_CONTENT_MAX)
        len = BLOCK_CONTENT_MAX;
    memcpy(block + BLOCK_HEADER_SIZE, content, len);
    uint8_t size = wire_seal_block(block, len, expected_sequence);
    sim_mcu_receive(block, size);
    sim_mcu_advance(now);
}

static void
boot(void)
{
    expected_sequence = 0;
    sim_mcu_boot(&board, now);
    sim_mcu_advance(now);
}

int
LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    now = 1000;
    noise = 1;
    boot();
    const uint8_t *end = data + size;
    uint64_t limit = now + (1u << 20);
    while (data < end && now < limit) {
        uint8_t step = *data++;
        if (step >= 0xc0) {
            uint8_t shift = step & 0x1f;
            now += 1u << (shift > 19 ? 19 : shift);
            sim_mcu_advance(now);
        } else {
            uint8_t len = step < 0x80 ? step : step & 0x3f;
            if (len > end - data)
                len = (uint8_t)(end - data);
            if (step < 0x80) {
                sim_mcu_receive(data, len);
                sim_mcu_advance(now);
            } else {
                send_sound_block(data, len);
            }
            data += len;
        }
        if (sim_mcu_take_reset())
            boot();
        require(sim_mcu_next_event() >= now);
    }
    return 0;
}
