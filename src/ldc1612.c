/* LDC1612: the frequency of a coil over a metal bed, from one channel on I2C.
 *
 *     every rest_ticks: timer ─► task: STATUS says there is a conversion (or INTB is low)? ─► DATA0 ─► sensor_bulk_data
 *                                                                                               └────► trigger_analog
 *
 * A sample is four bytes, high first: bits 27..0 the frequency in parts of 2^28 of the reference, bits 31..28 the chip's
 * errors of this conversion (under range, over range, watchdog, amplitude). 0xffffffff: the bus has failed. (SNOSCY9,
 * registers 0x00, 0x01, 0x18.) All settings of the chip are written by the host.
 */
#include "basecmd.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "i2ccmds.h"
#include "sched.h"
#include "sensor_bulk.h"
#include "trigger_analog.h"

enum ldc_failure { FAIL_I2C, FAIL_UNDER_RANGE, FAIL_OVER_RANGE, FAIL_WATCHDOG };
DECL_ENUMERATION("ldc1612_error:", "I2C", FAIL_I2C);
DECL_ENUMERATION("ldc1612_error:", "UNDER_RANGE", FAIL_UNDER_RANGE);
DECL_ENUMERATION("ldc1612_error:", "OVER_RANGE", FAIL_OVER_RANGE);
DECL_ENUMERATION("ldc1612_error:", "WATCHDOG", FAIL_WATCHDOG);

enum {
    REG_DATA0_MSB = 0x00,
    REG_DATA0_LSB = 0x01,
    REG_STATUS = 0x18,
    STATUS_UNREAD0 = 0x08,
    ERROR_UNDER = 0x80, ERROR_OVER = 0x40, ERROR_WATCHDOG = 0x20,  /* of the first byte */
    SAMPLE_BYTES = 4,
};

struct ldc1612 {
    struct timer timer;
    struct i2c_device *i2c;
    struct gpio_in intb;
    struct trigger_analog *trigger;
    uint32_t rest_ticks;
    uint8_t has_intb, reading_due;
    struct sensor_bulk bulk;
};

static struct task_wake ldc1612_wake;
static uint8_t ldc1612_type;

void
ldc1612_init(void)
{
    sched_check_wake(&ldc1612_wake);
}
DECL_INIT(ldc1612_init);

static uint8_t
read_register(struct ldc1612 *l, uint8_t reg, uint8_t *out)
{
    return i2c_device_exchange(l->i2c, &reg, 1, out, 2) == I2C_SUCCESS;
}

static void
put_sample(struct ldc1612 *l, uint8_t oid, const uint8_t *sample)
{
    for (uint8_t i = 0; i < SAMPLE_BYTES; i++)
        l->bulk.data[l->bulk.len++] = sample[i];
    if (l->bulk.len + SAMPLE_BYTES > SENSOR_BULK_SIZE)
        sensor_bulk_send(&l->bulk, oid);
}

static void
put_failure(struct ldc1612 *l, uint8_t oid)
{
    static const uint8_t none[SAMPLE_BYTES] = { 0xff, 0xff, 0xff, 0xff };
    l->bulk.possible_overflows++;
    trigger_analog_fail(l->trigger, FAIL_I2C);
    put_sample(l, oid, none);
}

/* STATUS lets go of INTB. Returns 0 if the bus has failed. */
static uint8_t
is_ready(struct ldc1612 *l, uint8_t *ready)
{
    uint8_t status[2];
    *ready = 0;
    if (l->has_intb && gpio_in_read(l->intb))
        return 1;
    if (!read_register(l, REG_STATUS, status))
        return 0;
    *ready = status[1] & STATUS_UNREAD0;
    return 1;
}

static void
read_sample(struct ldc1612 *l, uint8_t oid)
{
    uint8_t ready, data[SAMPLE_BYTES];
    if (!is_ready(l, &ready)) {
        put_failure(l, oid);
        return;
    }
    if (!ready)
        return;
    if (!read_register(l, REG_DATA0_MSB, data) || !read_register(l, REG_DATA0_LSB, data + 2)) {
        put_failure(l, oid);
        return;
    }
    if (data[0] & ERROR_UNDER)
        trigger_analog_fail(l->trigger, FAIL_UNDER_RANGE);
    else if (data[0] & ERROR_OVER)
        trigger_analog_fail(l->trigger, FAIL_OVER_RANGE);
    else if (data[0] & ERROR_WATCHDOG)
        trigger_analog_fail(l->trigger, FAIL_WATCHDOG);
    else
        trigger_analog_take(l->trigger, (int32_t)((uint32_t)(data[0] & 0x0f) << 24 | (uint32_t)data[1] << 16
                                                  | (uint32_t)data[2] << 8 | data[3]));
    put_sample(l, oid, data);
}

/* Timer; I2C is slow, so the task reads. With INTB only a conversion that has ended wakes it. */
static uint8_t
ldc1612_event(struct timer *t)
{
    struct ldc1612 *l = container_of(t, struct ldc1612, timer);
    if (!l->has_intb || !gpio_in_read(l->intb)) {
        l->reading_due = 1;
        sched_wake_task(&ldc1612_wake);
    }
    t->waketime += l->rest_ticks;
    return SF_RESCHEDULE;
}

void
ldc1612_task(void)
{
    uint8_t i;
    struct ldc1612 *l;
    if (!sched_check_wake(&ldc1612_wake))
        return;
    foreach_oid(i, l, &ldc1612_type) {
        irqstatus_t flag = irq_save();
        uint8_t due = l->reading_due;
        l->reading_due = 0;
        irq_restore(flag);
        if (due)
            read_sample(l, (uint8_t)(i - 1));
    }
}
DECL_TASK(ldc1612_task);

/* ---- commands ------------------------------------------------------------------------------ */

static struct ldc1612 *
configure(const struct command_args *args)
{
    struct i2c_device *i2c = i2c_device_lookup((uint8_t)args->val[1]);
    struct ldc1612 *l = oid_alloc((uint8_t)args->val[0], &ldc1612_type, sizeof(*l));
    l->timer.func = ldc1612_event;
    l->i2c = i2c;
    return l;
}

void
command_config_ldc1612(const struct command_args *args)
{
    configure(args);
}
DECL_COMMAND(command_config_ldc1612, "config_ldc1612 oid=%c i2c_oid=%c");

void
command_config_ldc1612_with_intb(const struct command_args *args)
{
    struct ldc1612 *l = configure(args);
    l->intb = gpio_in_setup(args->val[2], 1);
    l->has_intb = 1;
}
DECL_COMMAND(command_config_ldc1612_with_intb, "config_ldc1612_with_intb oid=%c i2c_oid=%c intb_pin=%c");

void
command_ldc1612_attach_trigger_analog(const struct command_args *args)
{
    struct trigger_analog *t = trigger_analog_lookup((uint8_t)args->val[1]);
    ((struct ldc1612 *)oid_lookup((uint8_t)args->val[0], &ldc1612_type))->trigger = t;
}
DECL_COMMAND(command_ldc1612_attach_trigger_analog, "ldc1612_attach_trigger_analog oid=%c trigger_analog_oid=%c");

/* Begin anew; rest_ticks 0: stop. */
void
command_query_ldc1612(const struct command_args *args)
{
    struct ldc1612 *l = oid_lookup((uint8_t)args->val[0], &ldc1612_type);
    irqstatus_t flag = irq_save();
    sched_del_timer(&l->timer);
    l->reading_due = 0;
    l->rest_ticks = args->val[1];
    l->timer.waketime = timer_read_time() + l->rest_ticks;
    if (l->rest_ticks)
        sched_add_timer(&l->timer);
    irq_restore(flag);
    sensor_bulk_reset(&l->bulk);
}
DECL_COMMAND(command_query_ldc1612, "query_ldc1612 oid=%c rest_ticks=%u");

void
command_query_status_ldc1612(const struct command_args *args)
{
    struct ldc1612 *l = oid_lookup((uint8_t)args->val[0], &ldc1612_type);
    uint8_t ready;
    uint32_t clock = timer_read_time();
    if (l->has_intb)
        ready = !gpio_in_read(l->intb);  /* reading STATUS would let go of the line */
    else if (!is_ready(l, &ready))
        l->bulk.possible_overflows++;
    uint32_t query_ticks = timer_read_time() - clock;
    sensor_bulk_status(&l->bulk, (uint8_t)args->val[0], clock, query_ticks, l->bulk.len + (ready ? SAMPLE_BYTES : 0));
}
DECL_COMMAND(command_query_status_ldc1612, "query_status_ldc1612 oid=%c");
