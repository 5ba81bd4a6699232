/* Converters for load cells: HX711 and HX717 on two pins, ADS1220 and ADS131M02/M04 on SPI. One channel of each is read.
 *
 *     every rest_ticks: timer ─► data ready? ─► task: read ─┬─► sensor_bulk_data, four bytes a sample, low byte first
 *                                                           └─► trigger_analog, while homing
 *
 *   HX71x     ready: DOUT low. 24 clock pulses give the bits, high first, 1 to 4 more choose gain and channel of the next
 *             conversion. A pulse of more than 60 us resets the chip: interrupts are off within one. (HX711 data sheet,
 *             serial interface)
 *   ADS1220   ready: DRDY low. 24 bits, high first. (SBAS501, 8.5)
 *   ADS131    ready: DRDY low. A frame of 24-bit words: status, the channels, check sum. (SBAS890, 8.5)
 *
 * All settings of the chips are written by the host. The bytes 0x80000000 are no sample but a failure: the chip has been
 * reset, or the pins do not answer as they should.
 */
#include <string.h>

#include "basecmd.h"
#include "board/delay.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"
#include "sensor_bulk.h"
#include "spicmds.h"
#include "trigger_analog.h"

enum adc_kind { HX71X, ADS1220, ADS131 };
enum adc_failure { FAIL_CONNECTION = 1, FAIL_RESET };
DECL_ENUMERATION("ads131m0x_error:", "SENSOR_ERROR_CRC", FAIL_CONNECTION);
DECL_ENUMERATION("ads131m0x_error:", "SENSOR_ERROR_RESET", FAIL_RESET);

enum {
    SAMPLE_BYTES = 4,
    ADS131_WORD = 3,
    ADS131_CHANNELS_MAX = 4,
    ADS131_FRAME_MAX = (2 + ADS131_CHANNELS_MAX) * ADS131_WORD,
    HX71X_BITS = 24,
    HX71X_PULSE_US = 1,
};

struct load_cell_adc {
    struct timer timer;
    struct gpio_in ready;
    struct gpio_out clock;  /* HX71x */
    struct spi_device *spi;
    struct trigger_analog *trigger;
    uint32_t rest_ticks;
    uint8_t kind, gain_pulses, channel, channels;
    uint8_t reading_due;
    struct sensor_bulk bulk;
};

static struct task_wake load_cell_wake;
static uint8_t load_cell_adc_type;

void
load_cell_adcs_init(void)
{
    sched_check_wake(&load_cell_wake);
}
DECL_INIT(load_cell_adcs_init);

/* ---- reading ------------------------------------------------------------------------------- */

static inline int32_t
signed_24(uint32_t bits)
{
    return (int32_t)(bits << 8) >> 8;
}

static uint8_t
hx71x_pulse(struct load_cell_adc *a)
{
    irqstatus_t flag = irq_save();
    gpio_out_write(a->clock, 1);
    delay_ticks(timer_from_us(HX71X_PULSE_US));
    gpio_out_write(a->clock, 0);
    uint8_t bit = gpio_in_read(a->ready);
    irq_restore(flag);
    delay_ticks(timer_from_us(HX71X_PULSE_US));
    return bit;
}

/* DOUT is high after the last pulse until the next conversion has ended; anything else is a wire. */
static uint8_t
read_hx71x(struct load_cell_adc *a, int32_t *value)
{
    uint32_t bits = 0;
    for (uint8_t i = 0; i < HX71X_BITS; i++)
        bits = bits << 1 | hx71x_pulse(a);
    for (uint8_t i = 0; i < a->gain_pulses; i++)
        hx71x_pulse(a);
    *value = signed_24(bits);
    return gpio_in_read(a->ready);
}

static uint8_t
read_ads1220(struct load_cell_adc *a, int32_t *value)
{
    uint8_t data[3] = { 0 };
    spi_device_exchange(a->spi, data, sizeof(data), 1);
    *value = signed_24((uint32_t)data[0] << 16 | (uint32_t)data[1] << 8 | data[2]);
    return 1;
}

/* CCITT, from 0xffff; over status and channels. */
static uint16_t
check_sum(const uint8_t *data, uint8_t len)
{
    uint16_t crc = 0xffff;
    while (len--) {
        crc ^= (uint16_t)(*data++ << 8);
        for (uint8_t i = 0; i < 8; i++)
            crc = (uint16_t)(crc & 0x8000 ? crc << 1 ^ 0x1021 : crc << 1);
    }
    return crc;
}

static uint8_t
read_ads131(struct load_cell_adc *a, int32_t *value, uint8_t *failure)
{
    uint8_t frame[ADS131_FRAME_MAX] = { 0 };
    uint8_t content = (uint8_t)((1 + a->channels) * ADS131_WORD);
    spi_device_exchange(a->spi, frame, (uint8_t)(content + ADS131_WORD), 1);
    if (check_sum(frame, content) != (uint16_t)(frame[content] << 8 | frame[content + 1])) {
        *failure = FAIL_CONNECTION;
        return 0;
    }
    if (frame[0] & 0x04) {  /* RESET of STATUS: the settings of the host are lost */
        *failure = FAIL_RESET;
        return 0;
    }
    const uint8_t *word = frame + (1 + a->channel) * ADS131_WORD;
    *value = signed_24((uint32_t)word[0] << 16 | (uint32_t)word[1] << 8 | word[2]);
    return 1;
}

static uint8_t
read_sample(struct load_cell_adc *a, int32_t *value, uint8_t *failure)
{
    *failure = FAIL_CONNECTION;
    if (a->kind == HX71X)
        return read_hx71x(a, value);
    return a->kind == ADS1220 ? read_ads1220(a, value) : read_ads131(a, value, failure);
}

static void
take_sample(struct load_cell_adc *a, uint8_t oid)
{
    int32_t value = INT32_MIN;
    uint8_t failure;
    if (read_sample(a, &value, &failure)) {
        trigger_analog_take(a->trigger, value);
    } else {
        value = INT32_MIN;
        trigger_analog_fail(a->trigger, failure);
    }
    uint8_t *out = a->bulk.data + a->bulk.len;
    for (uint8_t i = 0; i < SAMPLE_BYTES; i++)
        out[i] = (uint8_t)((uint32_t)value >> 8 * i);
    a->bulk.len += SAMPLE_BYTES;
    if (a->bulk.len + SAMPLE_BYTES > SENSOR_BULK_SIZE)
        sensor_bulk_send(&a->bulk, oid);
}

/* ---- rhythm -------------------------------------------------------------------------------- */

/* Timer, every rest_ticks (some 100 us): the pin alone. */
static uint8_t
load_cell_event(struct timer *t)
{
    struct load_cell_adc *a = container_of(t, struct load_cell_adc, timer);
    if (!gpio_in_read(a->ready)) {
        a->reading_due = 1;
        sched_wake_task(&load_cell_wake);
    }
    t->waketime += a->rest_ticks;
    return SF_RESCHEDULE;
}

void
load_cell_adcs_task(void)
{
    uint8_t i;
    struct load_cell_adc *a;
    if (!sched_check_wake(&load_cell_wake))
        return;
    foreach_oid(i, a, &load_cell_adc_type) {
        irqstatus_t flag = irq_save();
        uint8_t due = a->reading_due;
        a->reading_due = 0;
        irq_restore(flag);
        if (due && !gpio_in_read(a->ready))
            take_sample(a, (uint8_t)(i - 1));
    }
}
DECL_TASK(load_cell_adcs_task);

/* ---- commands ------------------------------------------------------------------------------ */

static struct load_cell_adc *
configure(const struct command_args *args, uint8_t kind, uint32_t ready_pin)
{
    struct load_cell_adc *a = oid_alloc((uint8_t)args->val[0], &load_cell_adc_type, sizeof(*a));
    a->timer.func = load_cell_event;
    a->kind = kind;
    a->ready = gpio_in_setup(ready_pin, 0);
    return a;
}

void
command_config_hx71x(const struct command_args *args)
{
    if (args->val[1] < 1 || args->val[1] > 4)
        shutdown(SHUTDOWN_HX71X_GAIN);
    struct load_cell_adc *a = configure(args, HX71X, args->val[2]);
    a->gain_pulses = (uint8_t)args->val[1];
    a->clock = gpio_out_setup(args->val[3], 0);
}
DECL_COMMAND(command_config_hx71x, "config_hx71x oid=%c gain_channel=%c dout_pin=%u sclk_pin=%u");

void
command_config_ads1220(const struct command_args *args)
{
    struct spi_device *spi = spi_device_lookup((uint8_t)args->val[1]);
    configure(args, ADS1220, args->val[2])->spi = spi;
}
DECL_COMMAND(command_config_ads1220, "config_ads1220 oid=%c spi_oid=%c data_ready_pin=%u");

void
command_config_ads131m0x(const struct command_args *args)
{
    struct spi_device *spi = spi_device_lookup((uint8_t)args->val[1]);
    if (!args->val[3] || args->val[3] > ADS131_CHANNELS_MAX || args->val[2] >= args->val[3])
        shutdown(SHUTDOWN_ADS131_CHANNELS);
    struct load_cell_adc *a = configure(args, ADS131, args->val[4]);
    a->spi = spi;
    a->channel = (uint8_t)args->val[2];
    a->channels = (uint8_t)args->val[3];
}
DECL_COMMAND(command_config_ads131m0x,
             "config_ads131m0x oid=%c spi_oid=%c channel=%c num_channels=%c data_ready_pin=%u");

static struct load_cell_adc *
adc_of(const struct command_args *args)
{
    return oid_lookup((uint8_t)args->val[0], &load_cell_adc_type);
}

void
command_attach_trigger_analog(const struct command_args *args)
{
    struct trigger_analog *t = trigger_analog_lookup((uint8_t)args->val[1]);
    adc_of(args)->trigger = t;
}
DECL_COMMAND(command_attach_trigger_analog, "hx71x_attach_trigger_analog oid=%c trigger_analog_oid=%c");
DECL_COMMAND(command_attach_trigger_analog, "ads1220_attach_trigger_analog oid=%c trigger_analog_oid=%c");
DECL_COMMAND(command_attach_trigger_analog, "ads131m0x_attach_trigger_analog oid=%c trigger_analog_oid=%c");

/* Begin anew; rest_ticks 0: stop. */
void
command_query_load_cell(const struct command_args *args)
{
    struct load_cell_adc *a = adc_of(args);
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
DECL_COMMAND(command_query_load_cell, "query_hx71x oid=%c rest_ticks=%u");
DECL_COMMAND(command_query_load_cell, "query_ads1220 oid=%c rest_ticks=%u");
DECL_COMMAND(command_query_load_cell, "query_ads131m0x oid=%c rest_ticks=%u");

void
command_query_load_cell_status(const struct command_args *args)
{
    struct load_cell_adc *a = adc_of(args);
    uint32_t clock = timer_read_time();
    uint32_t waiting = gpio_in_read(a->ready) ? 0 : SAMPLE_BYTES;
    uint32_t query_ticks = timer_read_time() - clock;
    sensor_bulk_status(&a->bulk, (uint8_t)args->val[0], clock, query_ticks, a->bulk.len + waiting);
}
DECL_COMMAND(command_query_load_cell_status, "query_hx71x_status oid=%c");
DECL_COMMAND(command_query_load_cell_status, "query_ads1220_status oid=%c");
DECL_COMMAND(command_query_load_cell_status, "query_ads131m0x_status oid=%c");
