/* Thermocouple and RTD converters on SPI, read in a fixed rhythm, with a limit that holds also when the host is dead.
 *
 *     every rest_ticks: timer ─► task reads the chip ─► thermocouple_result value, fault
 *                                                    └► fault, or value outside min..max: max_invalid_count of those in a
 *                                                       row shut down with "Thermocouple reader fault"
 *
 *   chip      read                             value                              fault
 *   MAX31855  4 bytes                          all 32 bits, top 14 signed °C/4    bits 0..2 of them
 *   MAX31856  registers 0x0C..0x0F             19 bits of °C/128, in 24, signed   register 0x0F
 *   MAX31865  registers 0x01..0x07             RTD registers, 16 bits             register 0x07 if bit 0 of value is set
 *   MAX6675   2 bytes                          16 bits, bits 3..14 in °C/4        bit 2 (open)
 *
 * Limits are compared as unsigned numbers; a value below 0 °C (MAX31855, MAX31856) counts as 0.  The chips' own settings
 * are written by the host beforehand (spi_send).
 */
#include "basecmd.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"
#include "spicmds.h"

DECL_RESPONSE(response_thermocouple, "thermocouple_result oid=%c next_clock=%u value=%u fault=%c");

enum chip_type { MAX31855, MAX31856, MAX31865, MAX6675, CHIP_TYPE_COUNT };
DECL_ENUMERATION("thermocouple_type", "MAX31855", MAX31855);
DECL_ENUMERATION("thermocouple_type", "MAX31856", MAX31856);
DECL_ENUMERATION("thermocouple_type", "MAX31865", MAX31865);
DECL_ENUMERATION("thermocouple_type", "MAX6675", MAX6675);

struct thermocouple {
    struct timer timer;
    struct spi_device *spi;
    uint32_t rest_ticks, min_value, max_value;
    uint32_t next_clock;       /* of the reading after the one due */
    uint8_t chip;
    uint8_t max_invalid_count, invalid_count;
    uint8_t reading_due;
};

struct reading {
    uint32_t value;
    uint8_t fault;
    uint8_t negative;
};

static struct task_wake thermocouple_wake;

void
thermocouple_init(void)
{
    sched_check_wake(&thermocouple_wake);
}
DECL_INIT(thermocouple_init);

static uint32_t
big_endian(const uint8_t *bytes, uint8_t count)
{
    uint32_t value = 0;
    while (count--)
        value = value << 8 | *bytes++;
    return value;
}

static struct reading
read_max31855(struct spi_device *spi)
{
    uint8_t data[4] = { 0 };
    spi_device_exchange(spi, data, sizeof(data), 1);
    uint32_t value = big_endian(data, 4);
    return (struct reading){ value, value & 7, data[0] >> 7 };
}

static struct reading
read_max31856(struct spi_device *spi)
{
    uint8_t data[5] = { 0x0c };  /* first register, then its address counts up */
    spi_device_exchange(spi, data, sizeof(data), 1);
    return (struct reading){ big_endian(data + 1, 3), data[4], data[1] >> 7 };
}

static struct reading
read_max31865(struct spi_device *spi)
{
    uint8_t data[8] = { 0x01 };
    spi_device_exchange(spi, data, sizeof(data), 1);
    uint32_t value = big_endian(data + 1, 2);
    return (struct reading){ value, value & 1 ? data[7] : 0, 0 };
}

static struct reading
read_max6675(struct spi_device *spi)
{
    uint8_t data[2] = { 0 };
    spi_device_exchange(spi, data, sizeof(data), 1);
    uint32_t value = big_endian(data, 2);
    return (struct reading){ value, value & 4, 0 };
}

static struct reading (*const read_chip[CHIP_TYPE_COUNT])(struct spi_device *) = {
    [MAX31855] = read_max31855,
    [MAX31856] = read_max31856,
    [MAX31865] = read_max31865,
    [MAX6675] = read_max6675,
};

/* Timer; the bus is slow, so the task does the reading.  Late: that reading is late, the rhythm keeps. */
static uint8_t
thermocouple_event(struct timer *t)
{
    struct thermocouple *c = container_of(t, struct thermocouple, timer);
    t->waketime += c->rest_ticks;
    c->next_clock = t->waketime;
    c->reading_due = 1;
    sched_wake_task(&thermocouple_wake);
    return SF_RESCHEDULE;
}

void
command_config_thermocouple(const struct command_args *args)
{
    struct spi_device *spi = spi_device_lookup((uint8_t)args->val[1]);
    if (args->val[2] >= CHIP_TYPE_COUNT)
        shutdown(SHUTDOWN_THERMOCOUPLE_TYPE);
    struct thermocouple *c = oid_alloc((uint8_t)args->val[0], command_config_thermocouple, sizeof(*c));
    c->spi = spi;
    c->chip = (uint8_t)args->val[2];
    c->timer.func = thermocouple_event;
}
DECL_COMMAND(command_config_thermocouple, "config_thermocouple oid=%c spi_oid=%c thermocouple_type=%c");

void
command_query_thermocouple(const struct command_args *args)
{
    struct thermocouple *c = oid_lookup((uint8_t)args->val[0], command_config_thermocouple);
    irqstatus_t flag = irq_save();
    sched_del_timer(&c->timer);
    c->timer.waketime = args->val[1];
    c->rest_ticks = args->val[2];
    c->min_value = args->val[3];
    c->max_value = args->val[4];
    c->max_invalid_count = (uint8_t)args->val[5];
    c->invalid_count = c->reading_due = 0;
    if (c->rest_ticks)
        sched_add_timer(&c->timer);
    irq_restore(flag);
}
DECL_COMMAND(command_query_thermocouple,
             "query_thermocouple oid=%c clock=%u rest_ticks=%u min_value=%u max_value=%u max_invalid_count=%c");

static void
check(struct thermocouple *c, const struct reading *r)
{
    uint32_t magnitude = r->negative ? 0 : r->value;
    if (!r->fault && magnitude >= c->min_value && magnitude <= c->max_value) {
        c->invalid_count = 0;
        return;
    }
    if (c->invalid_count < UINT8_MAX)
        c->invalid_count++;
    if (c->invalid_count >= c->max_invalid_count)
        try_shutdown(SHUTDOWN_THERMOCOUPLE_FAULT);
}

void
thermocouple_task(void)
{
    uint8_t i;
    struct thermocouple *c;
    if (!sched_check_wake(&thermocouple_wake))
        return;
    foreach_oid(i, c, command_config_thermocouple) {
        irqstatus_t flag = irq_save();
        uint8_t due = c->reading_due;
        uint32_t next_clock = c->next_clock;
        c->reading_due = 0;
        irq_restore(flag);
        if (!due)
            continue;
        struct reading r = read_chip[c->chip](c->spi);
        respond(&response_thermocouple, (uint8_t)(i - 1), next_clock, r.value, r.fault);
        check(c, &r);
    }
}
DECL_TASK(thermocouple_task);
