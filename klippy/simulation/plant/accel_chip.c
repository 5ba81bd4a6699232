/* Registers of accelerometers; see accel_chip.h. */
#include "accel_chip.h"

#include <math.h>
#include <string.h>

static const double GRAVITY_M_S2 = 9.80665;

enum { FIFO_NONE = -1 };

/* Where the parts that all chips have are. */
struct layout {
    uint8_t identity_at, identity;
    uint8_t data_at;     /* first register of a sample */
    uint8_t is_big_endian, is_window; /* window: one register gives all bytes of the FIFO in turn */
    uint8_t fifo_samples;
    double noise_ug;
};

static const struct layout layouts[ACCEL_KINDS] = {
    [ACCEL_ADXL345] = { 0x00, 0xe5, 0x32, 0, 0, 32, 400.0 },   /* 0.75 LSB of 3.9 mg in 50 Hz (Table 1) */
    [ACCEL_LIS2DW] = { 0x0f, 0x44, 0x28, 0, 0, 32, 90.0 },
    [ACCEL_LIS3DH] = { 0x0f, 0x33, 0x28, 0, 0, 32, 220.0 },
    [ACCEL_MPU9250] = { 0x75, 0x71, 0x74, 1, 1, 85, 300.0 },   /* 512 bytes */
    [ACCEL_ICM20948] = { 0x00, 0xea, 0x72, 1, 1, 85, 230.0 },  /* 512 bytes */
    [ACCEL_BMI160] = { 0x00, 0xd1, 0x24, 0, 1, 170, 180.0 },   /* 1024 bytes */
};

static uint8_t reg(const struct accel_chip *c, int bank, uint8_t at)
{
    return c->registers[bank][at];
}

void accel_chip_init(struct accel_chip *c, enum accel_kind kind)
{
    memset(c, 0, sizeof *c);
    c->kind = kind;
    c->registers[0][layouts[kind].identity_at] = layouts[kind].identity;
    if (kind == ACCEL_ADXL345)
        c->registers[0][0x2c] = 0x0a;
    if (kind == ACCEL_BMI160)
        c->registers[0][0x40] = 0x28, c->registers[0][0x41] = 0x03, c->registers[0][0x47] = 0x10;
    if (kind == ACCEL_MPU9250 || kind == ACCEL_ICM20948)
        c->registers[0][kind == ACCEL_MPU9250 ? 0x6b : 0x06] = kind == ACCEL_MPU9250 ? 0x01 : 0x41;
}

double accel_chip_noise(enum accel_kind kind)
{
    return layouts[kind].noise_ug;
}

double accel_chip_rate(const struct accel_chip *c)
{
    static const double lis2dw[] = { 0.0, 12.5, 12.5, 25.0, 50.0, 100.0, 200.0, 400.0, 800.0, 1600.0 };
    static const double lis3dh[] = { 0.0, 1.0, 10.0, 25.0, 50.0, 100.0, 200.0, 400.0, 1600.0, 1344.0 };
    uint8_t code = reg(c, 0, 0x20) >> 4;
    switch (c->kind) {
    case ACCEL_ADXL345:
        return reg(c, 0, 0x2d) & 0x08 ? 25.0 * exp2((reg(c, 0, 0x2c) & 15) - 8) : 0.0;
    case ACCEL_LIS2DW:
        return code < 10 ? lis2dw[code] : 0.0;
    case ACCEL_LIS3DH:
        return code < 10 ? lis3dh[code] : 0.0;
    case ACCEL_MPU9250:
        if (reg(c, 0, 0x6b) & 0x40)
            return 0.0;
        return reg(c, 0, 0x1d) & 0x08 ? 4000.0 : 1000.0 / (1 + reg(c, 0, 0x19));
    case ACCEL_ICM20948:
        if (reg(c, 0, 0x06) & 0x40)
            return 0.0;
        return reg(c, 2, 0x14) & 1 ? 1125.0 / (1 + ((reg(c, 2, 0x10) & 15) << 8 | reg(c, 2, 0x11))) : 4500.0;
    default:
        return (reg(c, 0, 0x03) >> 4 & 3) == 1 ? 100.0 * exp2((reg(c, 0, 0x40) & 15) - 8) : 0.0;
    }
}

/* Counts a g and the greatest count. */
static double counts_per_g(const struct accel_chip *c, double *max)
{
    *max = 32767.0;
    switch (c->kind) {
    case ACCEL_ADXL345: {
        int range = reg(c, 0, 0x31) & 3, is_full = reg(c, 0, 0x31) & 8;
        *max = is_full ? 512 * (1 << range) - 1 : 511;
        return is_full ? 256.0 : 256.0 / (1 << range);
    }
    case ACCEL_LIS2DW: /* 14 bits to the left of 16: 0.244 mg a count of 14 bits at 2 g */
        return 4.0 / (0.244e-3 * (1 << (reg(c, 0, 0x25) >> 4 & 3)));
    case ACCEL_LIS3DH: { /* 12 bits to the left of 16, mg a count of those */
        static const double mg[] = { 1.0, 2.0, 4.0, 12.0 };
        return 16.0 / (mg[reg(c, 0, 0x23) >> 4 & 3] * 1e-3);
    }
    case ACCEL_MPU9250:
        return 16384.0 / (1 << (reg(c, 0, 0x1c) >> 3 & 3));
    case ACCEL_ICM20948:
        return 16384.0 / (1 << (reg(c, 2, 0x14) >> 1 & 3));
    default: {
        int range = reg(c, 0, 0x41) & 15;
        return range == 12 ? 2048.0 : range == 8 ? 4096.0 : range == 5 ? 8192.0 : 16384.0;
    }
    }
}

static int collects(const struct accel_chip *c)
{
    switch (c->kind) {
    case ACCEL_ADXL345:
        return reg(c, 0, 0x38) >> 6 == 2;
    case ACCEL_LIS2DW:
        return reg(c, 0, 0x2e) >> 5 == 6;
    case ACCEL_LIS3DH:
        return (reg(c, 0, 0x24) & 0x40) && reg(c, 0, 0x2e) >> 6 == 2;
    case ACCEL_MPU9250:
        return (reg(c, 0, 0x6a) & 0x40) && (reg(c, 0, 0x23) & 0x08);
    case ACCEL_ICM20948:
        return (reg(c, 0, 0x03) & 0x40) && (reg(c, 0, 0x67) & 0x10);
    default:
        return (reg(c, 0, 0x47) & 0x50) == 0x40;
    }
}

/* What the low bits of a count cannot show. */
static int unused_bits(const struct accel_chip *c)
{
    return c->kind == ACCEL_LIS2DW ? 2 : c->kind == ACCEL_LIS3DH ? 4 : 0;
}

static void clear(struct accel_chip *c)
{
    c->fifo_first = c->fifo_count = c->overrun = c->byte = 0;
}

static void drop_oldest(struct accel_chip *c)
{
    c->fifo_first = (c->fifo_first + 1) % ACCEL_FIFO_MAX;
    c->fifo_count--;
    c->byte = 0;
}

void accel_chip_sample(struct accel_chip *c, const double accel_m_s2[3])
{
    double max, scale = counts_per_g(c, &max) / GRAVITY_M_S2;
    int shift = unused_bits(c);
    if (!collects(c))
        clear(c); /* only the last sample is kept */
    if (c->fifo_count >= layouts[c->kind].fifo_samples) {
        c->overrun = 1;
        drop_oldest(c);
    }
    int16_t *slot = c->fifo[(c->fifo_first + c->fifo_count++) % ACCEL_FIFO_MAX];
    for (int i = 0; i < 3; i++) {
        double count = fmin(fmax(accel_m_s2[i] * scale, -max - 1.0), max + 1.0 - (1 << shift));
        slot[i] = (int16_t)(lround(count / (1 << shift)) * (1 << shift));
    }
}

/* The next byte of the oldest sample; a chip without samples repeats the last one it had (bytes beyond: 0x80). */
static uint8_t take_byte(struct accel_chip *c)
{
    const struct layout *l = &layouts[c->kind];
    if (!c->fifo_count)
        return l->is_window ? 0x80 : 0x00;
    uint16_t value = (uint16_t)c->fifo[c->fifo_first][c->byte / 2];
    int is_high = l->is_big_endian != (c->byte & 1);
    c->byte++;
    if (c->byte == 6) {
        if (collects(c))
            drop_oldest(c);
        else
            c->byte = 0;
    }
    return (uint8_t)(is_high ? value >> 8 : value);
}

static int fifo_level(const struct accel_chip *c)
{
    return collects(c) ? c->fifo_count : 0;
}

static uint8_t read_count(struct accel_chip *c, uint8_t at)
{
    int bytes = fifo_level(c) * 6;
    switch (c->kind) {
    case ACCEL_ADXL345:
        return (uint8_t)fifo_level(c);
    case ACCEL_LIS2DW:
        return (uint8_t)((c->overrun ? 0x40 : 0) | fifo_level(c));
    case ACCEL_LIS3DH:
        return (uint8_t)(c->overrun ? 0x40 | 31 : fifo_level(c) == 32 ? 31 : fifo_level(c) | (fifo_level(c) ? 0 : 0x20));
    case ACCEL_BMI160:
        return (uint8_t)(at == 0x22 ? bytes : bytes >> 8);
    default:
        return (uint8_t)(at & 1 ? bytes : bytes >> 8);
    }
}

static int is_count(const struct accel_chip *c, uint8_t at)
{
    switch (c->kind) {
    case ACCEL_ADXL345:
        return at == 0x39;
    case ACCEL_MPU9250:
        return at == 0x72 || at == 0x73;
    case ACCEL_ICM20948:
        return c->bank == 0 && (at == 0x70 || at == 0x71);
    case ACCEL_BMI160:
        return at == 0x22 || at == 0x23;
    default:
        return at == 0x2f;
    }
}

/* Reads the register at c->address and goes on to the next. */
static uint8_t read_next(struct accel_chip *c)
{
    const struct layout *l = &layouts[c->kind];
    uint8_t at = c->address;
    int is_data = l->is_window ? at == l->data_at : at >= l->data_at && at < l->data_at + 6;
    if (is_data && (c->bank == 0 || c->kind != ACCEL_ICM20948)) {
        if (!l->is_window)
            c->address = (uint8_t)(at + 1 == l->data_at + 6 && c->kind != ACCEL_ADXL345 ? l->data_at : at + 1);
        return take_byte(c);
    }
    c->address++;
    if (is_count(c, at)) {
        uint8_t value = read_count(c, at);
        c->overrun = 0;
        return value;
    }
    return reg(c, c->bank, at);
}

/* Commands of the BMI160 (2.11.38). */
static void bmi160_command(struct accel_chip *c, uint8_t value)
{
    if (value == 0x11 || value == 0x10)
        c->registers[0][0x03] = value == 0x11 ? 0x10 : 0x00;
    if (value == 0xb0)
        clear(c);
    if (value == 0xb6)
        accel_chip_init(c, c->kind);
}

static void write_register(struct accel_chip *c, uint8_t at, uint8_t value)
{
    if (at == layouts[c->kind].identity_at && (c->kind != ACCEL_ICM20948 || c->bank == 0))
        return;
    if (c->kind == ACCEL_ICM20948 && at == 0x7f) {
        c->bank = value >> 4 & 3;
        return;
    }
    int was = collects(c);
    c->registers[c->bank][at] = value;
    if (was != collects(c))
        clear(c);
    if (c->kind == ACCEL_BMI160 && at == 0x7e)
        bmi160_command(c, value);
    int reset_at = c->kind == ACCEL_MPU9250 ? 0x6a : c->kind == ACCEL_ICM20948 ? 0x68 : FIFO_NONE;
    int reset_bit = c->kind == ACCEL_MPU9250 ? 0x04 : 0x1f;
    if (at == reset_at && (value & reset_bit))
        clear(c);
}

/* ---- buses ----------------------------------------------------------------------------------- */

void accel_chip_spi_select(struct accel_chip *c)
{
    c->place = 0;
    c->byte = 0;
}

uint8_t accel_chip_spi_byte(struct accel_chip *c, uint8_t sent)
{
    if (c->place++ == 0) {
        int has_flag = c->kind == ACCEL_ADXL345 || c->kind == ACCEL_LIS3DH; /* bit 6: count up */
        c->is_read = sent >> 7;
        c->address = sent & (has_flag ? 0x3f : 0x7f);
        return 0xff;
    }
    if (c->is_read)
        return read_next(c);
    write_register(c, c->address++, sent);
    return 0xff;
}

void accel_chip_i2c(struct accel_chip *c, const uint8_t *write, uint32_t write_len, uint8_t *read, uint32_t read_len)
{
    c->byte = 0;
    if (write_len)
        c->address = c->kind == ACCEL_LIS3DH ? write[0] & 0x7f : write[0];
    for (uint32_t i = 1; i < write_len; i++)
        write_register(c, c->address++, write[i]);
    for (uint32_t i = 0; i < read_len; i++)
        read[i] = read_next(c);
}
