/* Chips that digitise a probe's force or frequency; see gauge_chip.h. */
#include "gauge_chip.h"

#include <math.h>
#include <string.h>

/* ---- registers of the LDC1612 and the ADS131M0x ---------------------------------------------- */

enum {
    LDC_DATA0 = 0x00, LDC_RCOUNT0 = 0x08, LDC_SETTLE0 = 0x10, LDC_DIVIDERS0 = 0x14, LDC_STATUS = 0x18, LDC_ERROR = 0x19,
    LDC_CONFIG = 0x1a, LDC_MUX = 0x1b, LDC_RESET = 0x1c, LDC_DRIVE0 = 0x1e, LDC_MAKER = 0x7e, LDC_DEVICE = 0x7f,
    LDC_SLEEP = 1 << 13, LDC_UNREAD0 = 1 << 3, LDC_OVERRIDE = 1 << 12, LDC_NO_AUTO = 1 << 10,
    ADS131_STATUS = 1, ADS131_MODE = 2, ADS131_CLOCK = 3, ADS131_GAIN = 4, ADS131_CFG = 6, ADS131_RESET_BIT = 1 << 10,
};

static int is_ads131(const struct gauge_chip *c)
{
    return c->kind == GAUGE_ADS131M02 || c->kind == GAUGE_ADS131M04;
}

static int channels(const struct gauge_chip *c)
{
    return c->kind == GAUGE_ADS131M04 ? 4 : 2;
}

static void power_on(struct gauge_chip *c)
{
    memset(c->registers, 0, sizeof c->registers);
    c->fresh = c->running = 0;
    if (c->kind == GAUGE_LDC1612) {
        c->registers[LDC_RCOUNT0] = 0x0080;
        c->registers[LDC_CONFIG] = 0x2801;
        c->registers[LDC_MUX] = 0x020f;
        c->registers[LDC_MAKER] = 0x5449;
        c->registers[LDC_DEVICE] = 0x3055;
    } else if (is_ads131(c)) {
        c->registers[0] = (uint16_t)(0x2000 | channels(c) << 8);
        c->registers[ADS131_STATUS] = 0x0500;
        c->registers[ADS131_MODE] = 0x0510;
        c->registers[ADS131_CLOCK] = c->kind == GAUGE_ADS131M04 ? 0x0f0e : 0x030e;
        c->registers[ADS131_CFG] = 0x0600;
        c->answer = (uint16_t)(0xff20 | channels(c));
    }
}

void gauge_chip_init(struct gauge_chip *c, enum gauge_kind kind, double clock_hz, double line_rate_hz)
{
    memset(c, 0, sizeof *c);
    c->kind = kind;
    c->clock_hz = clock_hz;
    c->line_rate_hz = line_rate_hz;
    c->drive_optimum = 15.0;
    power_on(c);
}

static double ads1220_rate(const struct gauge_chip *c)
{
    static const double rates[] = { 20.0, 45.0, 90.0, 175.0, 330.0, 600.0, 1000.0, 0.0 };
    int turbo = (c->registers[1] >> 3 & 3) == 2;
    return c->running && c->registers[1] & 4 ? rates[c->registers[1] >> 5 & 7] * (turbo ? 2.0 : 1.0) : 0.0;
}

static double ads131_rate(const struct gauge_chip *c)
{
    uint16_t clock = c->registers[ADS131_CLOCK];
    double ratio = clock & 0x20 ? 64.0 : 128.0 * (1 << (clock >> 2 & 7));
    if (!(c->registers[ADS131_CFG] & 0x0100))
        return c->clock_hz / 2.0 / ratio;
    double delay = 2 << (c->registers[ADS131_CFG] >> 9 & 15);
    return c->clock_hz / 2.0 / (3.0 * ratio + delay);
}

static double ldc_rate(const struct gauge_chip *c)
{
    uint16_t divider = c->registers[LDC_DIVIDERS0] & 0x3ff;
    if (c->registers[LDC_CONFIG] & LDC_SLEEP || !divider || c->registers[LDC_RCOUNT0] < 5)
        return 0.0;
    return c->clock_hz / divider / (16.0 * c->registers[LDC_RCOUNT0] + 4.0);
}

double gauge_chip_rate(const struct gauge_chip *c)
{
    if (c->kind == GAUGE_LDC1612)
        return ldc_rate(c);
    if (c->kind == GAUGE_ADS1220)
        return ads1220_rate(c);
    return is_ads131(c) ? ads131_rate(c) : c->line_rate_hz;
}

static void ldc_convert(struct gauge_chip *c, double hz)
{
    uint16_t dividers = c->registers[LDC_DIVIDERS0];
    double reference_hz = c->clock_hz / (dividers & 0x3ff);
    double code = hz / (dividers >> 12) / reference_hz * 268435456.0;
    uint32_t word = code < 0.0 ? 0 : code > 268435455.0 ? 0x4fffffffu : (uint32_t)(code + 0.5); /* over range */
    if (c->registers[LDC_CONFIG] & LDC_OVERRIDE && c->registers[LDC_DRIVE0] >> 11 < c->drive_optimum - 8.0)
        word |= 0x10000000u; /* amplitude */
    c->registers[LDC_DATA0] = (uint16_t)(word >> 16);
    c->registers[LDC_DATA0 + 1] = (uint16_t)word;
    c->registers[LDC_STATUS] |= LDC_UNREAD0;
    if (!(c->registers[LDC_CONFIG] & LDC_NO_AUTO)) /* the current it finds by itself */
        c->registers[LDC_DRIVE0] = (uint16_t)((c->registers[LDC_DRIVE0] & 0xf83f) | (int)c->drive_optimum << 6);
}

void gauge_chip_convert(struct gauge_chip *c, double signal)
{
    c->fresh = 1;
    if (c->kind == GAUGE_LDC1612) {
        ldc_convert(c, signal);
        return;
    }
    double code = fmin(fmax(round(signal * 8388608.0), -8388608.0), 8388607.0);
    if (c->pulses > 24) /* HX71x: it has been read */
        c->pulses = 0;
    if (c->pulses == 0) /* not while it is being read */
        c->sample = (int32_t)code;
}

uint8_t gauge_chip_ready(const struct gauge_chip *c)
{
    if (c->kind == GAUGE_HX711 || c->kind == GAUGE_HX717)
        return c->pulses ? (c->pulses <= 24 ? c->shift >> (24 - c->pulses) & 1 : 1) : !c->fresh;
    return !c->fresh;
}

void gauge_chip_clock(struct gauge_chip *c, uint8_t level)
{
    if (level && !c->level) {
        if (c->pulses == 0) {
            c->shift = (uint32_t)c->sample & 0xffffff;
            c->fresh = 0;
        }
        c->pulses++;
    }
    c->level = level;
}

/* ---- SPI ------------------------------------------------------------------------------------- */

void gauge_chip_select(struct gauge_chip *c)
{
    c->frame_len = 0;
}

static void ads1220_frame(struct gauge_chip *c, uint8_t *data, uint32_t len)
{
    uint8_t command = data[0];
    if (command == 0x06) {
        power_on(c);
    } else if ((command & 0xfe) == 0x08) {
        c->running = 1;
    } else if ((command & 0xf0) == 0x40 || (command & 0xf0) == 0x20) {
        for (uint32_t i = 0; i <= (command & 3u) && i + 1 < len; i++) {
            uint32_t reg = (command >> 2 & 3u) + i;
            if (command & 0x40)
                c->registers[reg & 3] = data[1 + i];
            else
                data[1 + i] = (uint8_t)c->registers[reg & 3];
        }
    } else {
        for (uint32_t i = 0; i < len; i++)
            data[i] = i < 3 ? (uint8_t)((uint32_t)c->sample >> (16 - 8 * i)) : 0;
        c->fresh = 0;
    }
}

static uint16_t check_sum(const uint8_t *data, uint32_t len)
{
    uint16_t crc = 0xffff;
    for (uint32_t i = 0; i < 8 * len; i++) {
        uint16_t bit = data[i / 8] >> (7 - i % 8) & 1;
        crc = (uint16_t)((crc >> 15 ^ bit) & 1 ? crc << 1 ^ 0x1021 : crc << 1);
    }
    return crc;
}

static void put_word(uint8_t *out, uint32_t word)
{
    out[0] = (uint8_t)(word >> 16);
    out[1] = (uint8_t)(word >> 8);
    out[2] = (uint8_t)word;
}

static void ads131_frame(struct gauge_chip *c, uint8_t *data, uint32_t len)
{
    uint8_t out[GAUGE_FRAME_WORDS * 3] = { 0 };
    int words = channels(c) + 2;
    uint16_t command = (uint16_t)(data[0] << 8 | data[1]);
    uint32_t content = (uint32_t)(words - 1) * 3;
    put_word(out, (uint32_t)c->answer << 8);
    for (int i = 0; i < channels(c); i++)
        put_word(out + 3 * (1 + i), (uint32_t)c->sample & 0xffffff);
    put_word(out + content, (uint32_t)check_sum(out, content) << 8);
    if (len >= content)
        c->fresh = 0;
    c->answer = c->registers[ADS131_STATUS];
    if (command == 0x0011) {
        power_on(c);
    } else if (command >> 13 == 5) {
        c->answer = c->registers[command >> 7 & 63];
    } else if (command >> 13 == 3 && len >= 6) {
        c->registers[command >> 7 & 63] = (uint16_t)(data[3] << 8 | data[4]);
        c->answer = (uint16_t)(0x4000 | (command & 0x1fff));
        if ((command >> 7 & 63) == ADS131_MODE && !(data[3] & 0x04)) { /* RESET of MODE is cleared by the host */
            c->registers[ADS131_STATUS] &= (uint16_t)~ADS131_RESET_BIT;
        }
    }
    for (uint32_t i = 0; i < len; i++)
        data[i] = i < sizeof out ? out[i] : 0;
}

void gauge_chip_spi(struct gauge_chip *c, uint8_t *data, uint32_t len)
{
    if (!len)
        return;
    if (c->kind == GAUGE_ADS1220)
        ads1220_frame(c, data, len);
    else if (is_ads131(c))
        ads131_frame(c, data, len);
}

/* ---- I2C ------------------------------------------------------------------------------------- */

void gauge_chip_i2c(struct gauge_chip *c, const uint8_t *write, uint32_t write_len, uint8_t *read, uint32_t read_len)
{
    if (write_len)
        c->answer = write[0] & 0x7f;
    if (write_len >= 3) {
        uint16_t value = (uint16_t)(write[1] << 8 | write[2]);
        if (c->answer == LDC_RESET && value & 0x8000)
            power_on(c);
        else if (c->answer < LDC_MAKER && c->answer != LDC_STATUS)
            c->registers[c->answer] = value;
    }
    if (!read_len)
        return;
    uint16_t value = c->registers[c->answer];
    if (c->answer == LDC_STATUS)
        c->fresh = 0; /* INTB is let go */
    if (c->answer == LDC_DATA0)
        c->registers[LDC_STATUS] &= (uint16_t)~LDC_UNREAD0;
    for (uint32_t i = 0; i < read_len; i++)
        read[i] = i < 2 ? (uint8_t)(value >> (8 - 8 * i)) : 0xff;
}
