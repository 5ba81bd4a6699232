/* Accelerometers on SPI or I2C whose own memory (FIFO) collects samples; read in a fixed rhythm.
 *
 *     every rest_ticks: timer ─► task: how many samples has the chip? ─► read them ─► sensor_bulk_data, when one is full
 *     query_..._status: the same count, with the clock: from it the host works out when each sample was taken
 *
 *   chip       count                            samples                                      data sheet
 *   ADXL345    0x39 bits 0..5; full at 32       0x32..0x37, one at a time, 13 bits packed    ADXL345 rev. E, FIFO, registers
 *   LIS2DW12   0x2f bits 0..5; bit 6 overrun    0x28.., the address rolls back               DocID030730, 8.24; AN5038, 9
 *   LIS3DH     0x2f bits 0..4; bit 6 overrun    0x28.., the address rolls back               DocID17530, 8.24
 *   MPU-9250   0x72, 0x73; full at 512 bytes    0x74, high byte first                        RM-MPU-9250A-00, 4.27
 *   ICM-20948  0x70, 0x71; full at 512 bytes    0x72, high byte first                        DS-000189, 8.55
 *   BMI160     0x22, 0x23; full at 1024 bytes   0x24, low byte first                         BST-BMI160-DS000, 2.11.16
 *
 * A sample is six bytes as the chip sends them, but five for the ADXL345 (pack_adxl345). All settings of the chips are
 * written by the host. A count that cannot be means a wire is off: the host sees it as an overflow, or as a sample
 * that says so (ADXL345).
 */
#include <string.h>

#include "basecmd.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "i2ccmds.h"
#include "sched.h"
#include "sensor_bulk.h"
#include "spicmds.h"

enum chip_kind { LIS2DW, LIS3DH, ADXL345, MPU9250, ICM20948, BMI160 };
DECL_ENUMERATION("lis_chip_type", "LIS2DW", LIS2DW);
DECL_ENUMERATION("lis_chip_type", "LIS3DH", LIS3DH);
enum bus_kind { BUS_SPI, BUS_I2C, BUS_KIND_COUNT };
DECL_ENUMERATION("bus_oid_type", "spi", BUS_SPI);
DECL_ENUMERATION("bus_oid_type", "i2c", BUS_I2C);

enum {
    WORD_BYTES = 6,         /* three axes of 16 bits */
    ADXL345_BYTES = 5,
    BULK_WORDS = SENSOR_BULK_SIZE / WORD_BYTES,
    READ_BYTES = BULK_WORDS * WORD_BYTES,
    COUNT_FAILED = 0xffff,  /* the bus, or a count that cannot be */
    SPI_READ = 0x80,
};

struct accelerometer {
    struct timer timer;
    struct spi_device *spi;  /* one of the two */
    struct i2c_device *i2c;
    uint32_t rest_ticks;
    uint8_t kind;
    uint8_t reading_due;
    struct sensor_bulk bulk;
};

static struct task_wake accelerometer_wake;
static uint8_t accelerometer_type;  /* its address stands for this kind of object */

void
accelerometers_init(void)
{
    sched_check_wake(&accelerometer_wake);
}
DECL_INIT(accelerometers_init);

/* ---- registers ----------------------------------------------------------------------------- */

/* `reg` as the bus sends it. Returns 0 if the device does not answer. */
static uint8_t
read_registers(struct accelerometer *a, uint8_t reg, uint8_t *out, uint8_t len)
{
    if (a->i2c)
        return i2c_device_exchange(a->i2c, &reg, 1, out, len) == I2C_SUCCESS;
    uint8_t data[1 + READ_BYTES] = { reg | SPI_READ };
    spi_device_exchange(a->spi, data, (uint8_t)(1 + len), 1);
    memcpy(out, data + 1, len);
    return 1;
}

/* The flag for more than one byte: ADXL345 (SPI) bit 6; LIS3DH bit 6 on SPI, bit 7 on I2C; others count by themselves. */
static uint8_t
many(const struct accelerometer *a, uint8_t reg)
{
    if (a->kind == ADXL345 || (a->kind == LIS3DH && a->spi))
        return reg | 0x40;
    return a->kind == LIS3DH ? reg | 0x80 : reg;
}

/* Samples in a chip that counts them. */
static uint16_t
count_samples(struct accelerometer *a, uint8_t reg)
{
    uint8_t status;
    if (!read_registers(a, reg, &status, 1))
        return COUNT_FAILED;
    uint8_t count = status & (a->kind == LIS3DH ? 0x1f : 0x3f);
    uint8_t overrun = a->kind == ADXL345 ? count >= 32 : status & 0x40;
    if (status == 0xff || count > 33)
        return COUNT_FAILED;
    if (overrun) {
        a->bulk.possible_overflows++;
        return 32;
    }
    return count;
}

/* Samples in a chip that counts bytes; `mask` leaves the count, `size` is its memory. */
static uint16_t
count_bytes(struct accelerometer *a, uint8_t reg, uint8_t is_low_first, uint16_t mask, uint16_t size)
{
    uint8_t data[2];
    if (!read_registers(a, reg, data, 2) || (data[0] == 0xff && data[1] == 0xff))
        return COUNT_FAILED;
    uint16_t bytes = (uint16_t)(is_low_first ? data[1] << 8 | data[0] : data[0] << 8 | data[1]) & mask;
    if (bytes > size - WORD_BYTES)
        a->bulk.possible_overflows++;
    return bytes / WORD_BYTES;
}

static uint16_t
count_fifo(struct accelerometer *a)
{
    switch (a->kind) {
    case ADXL345:
        return count_samples(a, 0x39);
    case MPU9250:
        return count_bytes(a, 0x72, 0, 0x1fff, 512);
    case ICM20948:
        return count_bytes(a, 0x70, 0, 0x1fff, 512);
    case BMI160:
        return count_bytes(a, 0x22, 1, 0x07ff, 1024);
    default:
        return count_samples(a, 0x2f);
    }
}

static uint8_t
data_register(const struct accelerometer *a)
{
    static const uint8_t in_order[] = { 0x28, 0x28, 0x32, 0x74, 0x72, 0x24 };
    return many(a, in_order[a->kind]);
}

/* Five bytes on the wire: low bytes of x, y, z; upper bits of x with low ones of z's; upper bits of y with the rest.
 * Bit 7 of the last byte: no sample but a failure. */
static void
pack_adxl345(uint8_t *out, const uint8_t *raw)
{
    out[0] = raw[0];
    out[1] = raw[2];
    out[2] = raw[4];
    out[3] = (uint8_t)((raw[1] & 0x1f) | raw[5] << 5);
    out[4] = (uint8_t)((raw[3] & 0x1f) | (raw[5] & 0x18) << 2);
}

/* ---- rhythm -------------------------------------------------------------------------------- */

/* Timer; buses are slow, so the task reads. Late: the chip's memory holds the samples. */
static uint8_t
accelerometer_event(struct timer *t)
{
    struct accelerometer *a = container_of(t, struct accelerometer, timer);
    a->reading_due = 1;
    sched_wake_task(&accelerometer_wake);
    t->waketime += a->rest_ticks;
    return SF_RESCHEDULE;
}

static void
add_adxl345(struct accelerometer *a, uint8_t oid, uint8_t is_failure)
{
    uint8_t raw[WORD_BYTES];
    if (a->bulk.len + ADXL345_BYTES > SENSOR_BULK_SIZE)
        sensor_bulk_send(&a->bulk, oid);
    uint8_t *out = a->bulk.data + a->bulk.len;
    if (is_failure) {
        memset(out, 0xff, ADXL345_BYTES);
    } else {
        read_registers(a, data_register(a), raw, sizeof(raw));
        pack_adxl345(out, raw);
    }
    a->bulk.len += ADXL345_BYTES;
}

/* Up to a message's worth; returns how many samples. */
static uint8_t
add_words(struct accelerometer *a, uint8_t oid, uint16_t count)
{
    uint8_t room = (uint8_t)((SENSOR_BULK_SIZE - a->bulk.len) / WORD_BYTES);
    if (!room) {
        sensor_bulk_send(&a->bulk, oid);
        room = BULK_WORDS;
    }
    if (room > count)
        room = (uint8_t)count;
    uint8_t bytes = room * WORD_BYTES;
    if (read_registers(a, data_register(a), a->bulk.data + a->bulk.len, bytes))
        a->bulk.len += bytes;
    else
        a->bulk.possible_overflows++;
    return room;
}

/* One reading; a full message goes out at once, so that the last one is no later than the next reading. */
static void
read_fifo(struct accelerometer *a, uint8_t oid)
{
    uint16_t count = count_fifo(a);
    uint8_t bytes = a->kind == ADXL345 ? ADXL345_BYTES : WORD_BYTES;
    if (count == COUNT_FAILED) {
        a->bulk.possible_overflows++;
        if (a->kind == ADXL345)
            add_adxl345(a, oid, 1);
        count = 0;
    }
    while (count) {
        if (a->kind == ADXL345) {
            add_adxl345(a, oid, 0);
            count--;
        } else {
            count -= add_words(a, oid, count);
        }
    }
    if (a->bulk.len + bytes > SENSOR_BULK_SIZE)
        sensor_bulk_send(&a->bulk, oid);
}

void
accelerometers_task(void)
{
    uint8_t i;
    struct accelerometer *a;
    if (!sched_check_wake(&accelerometer_wake))
        return;
    foreach_oid(i, a, &accelerometer_type) {
        irqstatus_t flag = irq_save();
        uint8_t due = a->reading_due;
        a->reading_due = 0;
        irq_restore(flag);
        if (due)
            read_fifo(a, (uint8_t)(i - 1));
    }
}
DECL_TASK(accelerometers_task);

/* ---- commands ------------------------------------------------------------------------------ */

static void
configure(const struct command_args *args, uint8_t kind, uint8_t bus)
{
    uint8_t bus_oid = (uint8_t)args->val[1];
    struct spi_device *spi = bus == BUS_SPI ? spi_device_lookup(bus_oid) : NULL;
    struct i2c_device *i2c = bus == BUS_SPI ? NULL : i2c_device_lookup(bus_oid);
    struct accelerometer *a = oid_alloc((uint8_t)args->val[0], &accelerometer_type, sizeof(*a));
    a->timer.func = accelerometer_event;
    a->spi = spi;
    a->i2c = i2c;
    a->kind = kind;
}

/* A bus of the host's choice. */
static uint8_t
checked_bus(uint32_t bus)
{
    if (bus >= BUS_KIND_COUNT)
        shutdown(SHUTDOWN_BUS_TYPE);
    return (uint8_t)bus;
}

void
command_config_adxl345(const struct command_args *args)
{
    configure(args, ADXL345, BUS_SPI);
}
DECL_COMMAND(command_config_adxl345, "config_adxl345 oid=%c spi_oid=%c");

void
command_config_lis2dw(const struct command_args *args)
{
    if (args->val[3] > LIS3DH)
        shutdown(SHUTDOWN_MODEL_TYPE);
    configure(args, (uint8_t)args->val[3], checked_bus(args->val[2]));
}
DECL_COMMAND(command_config_lis2dw, "config_lis2dw oid=%c bus_oid=%c bus_oid_type=%c lis_chip_type=%c");

void
command_config_mpu9250(const struct command_args *args)
{
    configure(args, MPU9250, BUS_I2C);
}
DECL_COMMAND(command_config_mpu9250, "config_mpu9250 oid=%c i2c_oid=%c");

void
command_config_icm20948(const struct command_args *args)
{
    configure(args, ICM20948, BUS_I2C);
}
DECL_COMMAND(command_config_icm20948, "config_icm20948 oid=%c i2c_oid=%c");

void
command_config_bmi160(const struct command_args *args)
{
    configure(args, BMI160, checked_bus(args->val[2]));
}
DECL_COMMAND(command_config_bmi160, "config_bmi160 oid=%c bus_oid=%c bus_oid_type=%c");

/* Begin anew with the first reading after one rest; rest_ticks 0: stop. */
void
command_query_accelerometer(const struct command_args *args)
{
    struct accelerometer *a = oid_lookup((uint8_t)args->val[0], &accelerometer_type);
    irqstatus_t flag = irq_save();
    sched_del_timer(&a->timer);
    a->reading_due = 0;
    a->rest_ticks = args->val[1];
    a->timer.waketime = timer_read_time() + a->rest_ticks;
    if (a->rest_ticks)
        sched_add_timer(&a->timer);
    irq_restore(flag);
    sensor_bulk_reset(&a->bulk);
}
DECL_COMMAND(command_query_accelerometer, "query_adxl345 oid=%c rest_ticks=%u");
DECL_COMMAND(command_query_accelerometer, "query_lis2dw oid=%c rest_ticks=%u");
DECL_COMMAND(command_query_accelerometer, "query_mpu9250 oid=%c rest_ticks=%u");
DECL_COMMAND(command_query_accelerometer, "query_icm20948 oid=%c rest_ticks=%u");
DECL_COMMAND(command_query_accelerometer, "query_bmi160 oid=%c rest_ticks=%u");

void
command_query_accelerometer_status(const struct command_args *args)
{
    struct accelerometer *a = oid_lookup((uint8_t)args->val[0], &accelerometer_type);
    uint8_t bytes = a->kind == ADXL345 ? ADXL345_BYTES : WORD_BYTES;
    uint32_t clock = timer_read_time();
    uint16_t count = count_fifo(a);
    uint32_t query_ticks = timer_read_time() - clock;
    if (count == COUNT_FAILED) {
        a->bulk.possible_overflows++;
        count = 0;
    }
    sensor_bulk_status(&a->bulk, (uint8_t)args->val[0], clock, query_ticks, a->bulk.len + (uint32_t)count * bytes);
}
DECL_COMMAND(command_query_accelerometer_status, "query_adxl345_status oid=%c");
DECL_COMMAND(command_query_accelerometer_status, "query_lis2dw_status oid=%c");
DECL_COMMAND(command_query_accelerometer_status, "query_mpu9250_status oid=%c");
DECL_COMMAND(command_query_accelerometer_status, "query_icm20948_status oid=%c");
DECL_COMMAND(command_query_accelerometer_status, "query_bmi160_status oid=%c");
