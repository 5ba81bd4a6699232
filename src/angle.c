/* Magnetic angle sensors on SPI, read in a fixed rhythm: the shaft of a motor.
 *
 *     at clock, and every rest_ticks: timer ─► task: angle and how late it was read ─► sensor_bulk_data, three bytes a sample
 *
 *   chip       read                                              angle                          data sheet
 *   A1333      register 0x32; the answer comes a frame later     bits 14..0                     A1333-DS, serial registers
 *   AS5047D    register 0x3fff, even parity; a frame later       bits 13..0; bit 14: error      v1-12, SPI
 *   TLE5012B   0x8021: register 2, one word and a safety word    bits 14..0                     V2.1, SSC
 *   MT6816     registers 3 and 4                                 bits 15..2; bit 1: no magnet   Rev. 2.1, SPI
 *   MT6826S    burst from register 3                             bits 15..1; of byte 2 bit 1    Rev. 1.1, SPI
 *
 * A sample: how late it was read in units of 2^time_shift ticks (255: no sample but a failure), then the angle, low byte
 * first, 65536 a turn. Sample n is due at clock + n · rest_ticks. Settings are written by the host with spi_angle_transfer.
 */
#include <string.h>

#include "basecmd.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"
#include "sensor_bulk.h"
#include "spicmds.h"

enum angle_kind { A1333, AS5047D, TLE5012B, MT6816, MT6826S, ANGLE_KINDS };
DECL_ENUMERATION("spi_angle_type", "a1333", A1333);
DECL_ENUMERATION("spi_angle_type", "as5047d", AS5047D);
DECL_ENUMERATION("spi_angle_type", "tle5012b", TLE5012B);
DECL_ENUMERATION("spi_angle_type", "mt6816", MT6816);
DECL_ENUMERATION("spi_angle_type", "mt6826s", MT6826S);

enum { SAMPLE_BYTES = 3, LATE_FAILURE = 0xff, LATE_MAX = 0xfe, TRANSFER_MAX = 32 };

DECL_RESPONSE(response_spi_angle_transfer, "spi_angle_transfer_response oid=%c clock=%u response=%*s");

struct angle {
    struct timer timer;
    struct spi_device *spi;
    uint32_t rest_ticks, next_due;
    uint8_t kind, time_shift, reading_due, overdue;
    struct sensor_bulk bulk;
};

static struct task_wake angle_wake;
static uint8_t angle_type;

void
angle_init(void)
{
    sched_check_wake(&angle_wake);
}
DECL_INIT(angle_init);

static uint8_t
has_odd_parity(uint16_t word)
{
    word ^= word >> 8;
    word ^= word >> 4;
    return (0x6996 >> (word & 0x0f)) & 1;
}

/* The answer to `command`, which comes with the next frame. */
static uint16_t
exchange_twice(struct angle *a, uint8_t high, uint8_t low)
{
    uint8_t data[2] = { high, low }, answer[2] = { high, low };
    spi_device_exchange(a->spi, data, 2, 0);
    spi_device_exchange(a->spi, answer, 2, 1);
    return (uint16_t)(answer[0] << 8 | answer[1]);
}

/* Returns 0 if the chip says that there is none, or nothing answers. */
static uint8_t
read_angle(struct angle *a, uint16_t *out)
{
    uint8_t data[6] = { 0 };
    uint16_t word;
    switch (a->kind) {
    case A1333:
        word = exchange_twice(a, 0x32, 0x00);
        *out = (uint16_t)(word << 1);
        return !(word & 0x8000);
    case AS5047D:
        word = exchange_twice(a, 0xff, 0xff);
        *out = (uint16_t)(word << 2);
        return !(word & 0x4000) && !has_odd_parity(word);
    case TLE5012B:
        data[0] = 0x80;
        data[1] = 0x21;
        spi_device_exchange(a->spi, data, 6, 1);
        *out = (uint16_t)((data[2] << 8 | data[3]) << 1);
        return data[4] & 0x40 && data[5] != 0xff;  /* S_ACC of the safety word: a valid access */
    case MT6816:
        data[0] = 0x83;
        spi_device_exchange(a->spi, data, 3, 1);
        word = (uint16_t)(data[1] << 8 | data[2]);
        *out = word & 0xfffc;
        return !(word & 2) && !has_odd_parity(word);
    default:
        data[0] = 0xa0;
        data[1] = 0x03;
        spi_device_exchange(a->spi, data, 6, 1);
        *out = (uint16_t)(data[2] << 8 | (data[3] & 0xfe));
        return !(data[4] & 2) && data[5] != 0xff;  /* weak field; the line is pulled up */
    }
}

static void
take_sample(struct angle *a, uint8_t oid, uint32_t due)
{
    uint16_t angle = 0;
    uint32_t late = (timer_read_time() - due) >> a->time_shift;
    uint8_t good = read_angle(a, &angle) && late <= LATE_MAX;
    uint8_t *out = a->bulk.data + a->bulk.len;
    out[0] = good ? (uint8_t)late : LATE_FAILURE;
    out[1] = (uint8_t)angle;
    out[2] = (uint8_t)(angle >> 8);
    a->bulk.len += SAMPLE_BYTES;
    if (a->bulk.len + SAMPLE_BYTES > SENSOR_BULK_SIZE)
        sensor_bulk_send(&a->bulk, oid);
}

/* Timer. A sample that the task has not read before the next is due is lost: a failure stands in its place. */
static uint8_t
angle_event(struct timer *t)
{
    struct angle *a = container_of(t, struct angle, timer);
    if (a->reading_due)
        a->overdue++;
    else
        a->next_due = t->waketime;
    a->reading_due = 1;
    sched_wake_task(&angle_wake);
    t->waketime += a->rest_ticks;
    return SF_RESCHEDULE;
}

void
angle_task(void)
{
    uint8_t i;
    struct angle *a;
    if (!sched_check_wake(&angle_wake))
        return;
    foreach_oid(i, a, &angle_type) {
        irqstatus_t flag = irq_save();
        uint8_t count = a->reading_due ? 1 + a->overdue : 0;
        uint32_t due = a->next_due;
        a->reading_due = a->overdue = 0;
        irq_restore(flag);
        while (count--) {
            take_sample(a, (uint8_t)(i - 1), due);
            due += a->rest_ticks;
        }
    }
}
DECL_TASK(angle_task);

void
command_config_spi_angle(const struct command_args *args)
{
    if (args->val[2] >= ANGLE_KINDS)
        shutdown(SHUTDOWN_ANGLE_TYPE);
    struct spi_device *spi = spi_device_lookup((uint8_t)args->val[1]);
    struct angle *a = oid_alloc((uint8_t)args->val[0], &angle_type, sizeof(*a));
    a->timer.func = angle_event;
    a->spi = spi;
    a->kind = (uint8_t)args->val[2];
}
DECL_COMMAND(command_config_spi_angle, "config_spi_angle oid=%c spi_oid=%c spi_angle_type=%c");

/* Begin anew at `clock`; rest_ticks 0: stop. */
void
command_query_spi_angle(const struct command_args *args)
{
    struct angle *a = oid_lookup((uint8_t)args->val[0], &angle_type);
    irqstatus_t flag = irq_save();
    sched_del_timer(&a->timer);
    a->reading_due = a->overdue = 0;
    a->timer.waketime = args->val[1];
    a->rest_ticks = args->val[2];
    a->time_shift = args->val[3] & 31;
    if (a->rest_ticks)
        sched_add_timer(&a->timer);
    irq_restore(flag);
    sensor_bulk_reset(&a->bulk);
}
DECL_COMMAND(command_query_spi_angle, "query_spi_angle oid=%c clock=%u rest_ticks=%u time_shift=%c");

/* The clock is that at the end of the first word: a TLE5012B then takes the angle over. */
void
command_spi_angle_transfer(const struct command_args *args)
{
    uint8_t oid = (uint8_t)args->val[0];
    struct angle *a = oid_lookup(oid, &angle_type);
    uint8_t data[TRANSFER_MAX];
    uint8_t len = args->data_len < TRANSFER_MAX ? args->data_len : TRANSFER_MAX;
    memcpy(data, args->data, len);  /* they lie in the receive buffer */
    uint32_t clock = timer_read_time();
    spi_device_exchange(a->spi, data, len, 1);
    respond(&response_spi_angle_transfer, oid, clock, (unsigned int)len, data);
}
DECL_COMMAND(command_spi_angle_transfer, "spi_angle_transfer oid=%c data=%*s");
