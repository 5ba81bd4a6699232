/* ADC1 and ADC2 (RM0364 chapter 13): single conversions by software, regular or injected, conversions in step with HRTIM moved by
 * DMA.
 *
 * Conversions in step are made late and many at a time: when the DMA channel's half or end is due, when somebody looks, and before
 * the bridge changes, so that all samples asked for at once lie under one phase. Between these instants the buffer in
 * memory is older than the chip's would be.
 */
#include "chip.h"

#include <string.h>

enum {
    ISR = 0x00, IER = 0x04, CR = 0x08, CFGR = 0x0c, SMPR1 = 0x14, SMPR2 = 0x18, TR1 = 0x20, TR3 = 0x28, SQR1 = 0x30,
    SQR4 = 0x3c, DR = 0x40, JSQR = 0x4c, OFR1 = 0x60, OFR4 = 0x6c, JDR1 = 0x80, JDR4 = 0x8c, DIFSEL = 0xb0, CALFACT = 0xb4,
    COMMON_CSR = 0x300, COMMON_CCR = 0x308,
    ADRDY = 1u << 0, EOSMP = 1u << 1, EOC = 1u << 2, EOS = 1u << 3, OVR = 1u << 4, JEOC = 1u << 5, JEOS = 1u << 6,
    ADEN = 1u << 0, ADDIS = 1u << 1, ADSTART = 1u << 2, JADSTART = 1u << 3, ADSTP = 1u << 4, JADSTP = 1u << 5, ADCAL = 1u << 31,
    TSEN = 1u << 23,
    DMAEN = 1u << 0, DMACFG = 1u << 1, CONT = 1u << 13, OVRMOD = 1u << 12,
    UNITS = 2, REGULATOR_TICKS = 720 /* 10 us, DS9994 table 63 */, CALIBRATION_CYCLES = 112, BATCH = 256,
    TRIGGER_HRTIM1 = 7, TRIGGER_HRTIM3 = 8, NO_PIN = 0xff, CHANNEL_SENSOR = 16,
    SENSOR_START_TICKS = 720, SENSOR_SAMPLING_TICKS = 159, /* 10 us, 2.2 us: DS9994, temperature sensor characteristics */
};

static struct adc {
    uint32_t isr, ier, cr, cfgr, smpr[2], tr[3], sqr[4], jsqr, ofr[4], dr, jdr, difsel, calfact;
    uint64_t regulator_at, calibrated_at, ready_at;
    uint8_t regulator_step, calibrated;
    struct event done, injected, dma;
    int in_step;             /* converting at each trigger of HRTIM */
    uint32_t moved;         /* by how much that has moved within the period since the conversions began */
    uint64_t first_trigger;  /* clock of the next trigger that has not been converted */
    uint32_t period;
} adcs[UNITS];
static uint32_t common_ccr;
static uint64_t sensor_at; /* from when on the temperature sensor is good */

/* Channel to pin (DS9994 table 13): port A 0.., B 16.., C 32.. */
static const uint8_t PIN_OF[UNITS][19] = {
    { NO_PIN, 0, 1, 2, 3, NO_PIN, 32, 33, 34, 35, NO_PIN, 16, 17, 29, NO_PIN, NO_PIN, NO_PIN, NO_PIN, NO_PIN },
    { NO_PIN, 4, 5, 6, 7, 36, 32, 33, 34, 35, NO_PIN, 37, 18, 28, 30, 31, NO_PIN, NO_PIN, NO_PIN },
};

static uint32_t clock_hz(void)
{
    static const uint8_t DIVIDER[4] = { 0, 1, 2, 4 };
    uint32_t mode = common_ccr >> 16 & 3u;
    return mode ? clocks.hclk / DIVIDER[mode] : clocks.adc_async;
}

static double sampling_ticks(const struct adc *a, unsigned channel, unsigned more_half_cycles)
{
    static const uint16_t SAMPLE_X2[8] = { 3, 5, 9, 15, 39, 123, 363, 1203 }; /* sampling cycles, doubled */
    uint32_t smp = a->smpr[channel / 10] >> 3 * (channel % 10) & 7u;
    return ticks_of(SAMPLE_X2[smp] + more_half_cycles, 2 * clock_hz());
}

static uint64_t conversion_ticks(const struct adc *a, unsigned channel)
{
    return (uint64_t)sampling_ticks(a, channel, 25) + 1;
}

static unsigned first_channel(const struct adc *a)
{
    return a->sqr[0] >> 6 & 31u;
}

static void update_line(void)
{
    int line = 0;
    for (unsigned i = 0; i < UNITS; i++)
        line |= (adcs[i].isr & adcs[i].ier) != 0;
    nvic_line(IRQ_ADC, line);
}

/* ADC1: channel 1. ADC2: channel 2, or 4 (SYSCFG_CFGR3, ADC2_DMA_RMP). */
static unsigned dma_channel(unsigned unit)
{
    if (unit == 0)
        return 1;
    return (syscfg_remap3() >> 8 & 3u) == 3u ? 4 : 2;
}

/* V_TS is wired to ADC1 only (RM0364). */
static int check_sensor(const struct adc *a)
{
    if (!(common_ccr & TSEN) || now() < sensor_at)
        fault("ADC1 converts the temperature sensor, which is off or has not been on for 10 us (TSEN)");
    if (sampling_ticks(a, CHANNEL_SENSOR, 0) < SENSOR_SAMPLING_TICKS)
        fault("ADC1 samples the temperature sensor for less than 2.2 us (DS9994)");
    return SIM_PIN_TEMPERATURE;
}

static int check_input(unsigned unit, unsigned channel)
{
    if (unit == 0 && channel == CHANNEL_SENSOR)
        return check_sensor(&adcs[unit]);
    unsigned pin = channel < 19 ? PIN_OF[unit][channel] : NO_PIN;
    if (pin == NO_PIN) {
        fault("ADC%u converts channel %u, which is no pin of this package", unit + 1, channel);
        return -1;
    }
    if (gpio_mode(pin) != MODE_ANALOG)
        fault("ADC%u converts channel %u, and its pin P%c%u is not in analog mode", unit + 1, channel, 'A' + pin / 16, pin % 16);
    return (int)pin;
}

/* ---- conversions in step with the bridge -------------------------------------------------------------- */

static int triggers(const struct adc *a, uint32_t *period, uint64_t *at)
{
    uint32_t source = a->cfgr >> 6 & 15u;
    if (!(a->cfgr >> 10 & 3u) || (source != TRIGGER_HRTIM1 && source != TRIGGER_HRTIM3))
        return 0;
    return hrtim_adc_trigger(source == TRIGGER_HRTIM1 ? 1 : 3, period, at);
}

static void take(unsigned unit, uint64_t before)
{
    struct adc *a = &adcs[unit];
    unsigned channel = dma_channel(unit);
    uint16_t samples[BATCH];
    while (a->in_step && a->first_trigger < before) {
        uint64_t count = (before - 1 - a->first_trigger) / a->period + 1;
        uint32_t part = count < BATCH ? (uint32_t)count : BATCH;
        board.sync_adc_read(board.ctx, samples, part, a->first_trigger, a->period);
        for (uint32_t i = 0; i < part; i++)
            record(RECORD_SAMPLES, a->first_trigger + (uint64_t)i * a->period, samples[i]);
        a->first_trigger += (uint64_t)part * a->period;
        counters.samples += part;
        if (a->cfgr & DMAEN && dma_enabled(channel) && !(a->isr & OVR)) {
            dma_block(channel, samples, part);
        } else {
            counters.samples_lost += part;
            a->isr |= EOC | EOS | (a->isr & EOC ? OVR : 0);
        }
        a->dr = samples[part - 1];
    }
}

/* The next look: when the DMA channel's next notice is due. */
static void plan(unsigned unit)
{
    struct adc *a = &adcs[unit];
    uint64_t due = NEVER;
    if (a->in_step) {
        unsigned channel = dma_channel(unit);
        uint32_t ahead = a->cfgr & DMAEN && dma_enabled(channel) ? dma_until_notice(channel) : BATCH;
        due = a->first_trigger + (uint64_t)(ahead - 1) * a->period + conversion_ticks(a, first_channel(a));
    }
    event_at(&a->dma, due);
}

static void sync(unsigned unit)
{
    struct adc *a = &adcs[unit];
    uint64_t delay = a->in_step ? conversion_ticks(a, first_channel(a)) : 0;
    if (a->in_step && now() + 1 > delay)
        take(unit, now() + 1 - delay);
}

static void dma_due(void *arg)
{
    unsigned unit = (unsigned)((struct adc *)arg - adcs);
    sync(unit);
    plan(unit);
    update_line();
}

void adc_sync(void)
{
    for (unsigned i = 0; i < UNITS; i++)
        if (adcs[i].in_step)
            sync(i);
}

void adc_before_change(void)
{
    for (unsigned i = 0; i < UNITS; i++)
        if (adcs[i].in_step)
            take(i, now());
}

static void update_step(unsigned unit)
{
    struct adc *a = &adcs[unit];
    uint32_t period = 0;
    uint64_t at = 0;
    int steps = a->cr & ADSTART && !(a->cfgr & CONT) && triggers(a, &period, &at);
    if (a->in_step)
        sync(unit);
    if (steps && (!a->in_step || period != a->period || (a->first_trigger - at) % period)) {
        unsigned channel = first_channel(a);
        check_input(unit, channel);
        if (conversion_ticks(a, channel) >= period)
            fault("ADC%u: a conversion takes longer than the bridge's period", unit + 1);
        if (a->sqr[0] & 15u)
            fault("ADC%u: more than one conversion a trigger is not modelled (SQR1 = 0x%x)", unit + 1, a->sqr[0]);
        uint32_t later = a->in_step && period == a->period ? (uint32_t)((at + period - a->first_trigger % period) % period) : 0;
        a->moved = a->in_step ? (a->moved + later) % period : 0;
        if (board.sync_adc_move)
            board.sync_adc_move(board.ctx, a->moved, now());
        if (later) /* there is one trigger in each period, also when the edge before it is noticed late */
            a->first_trigger += later < period / 2 ? later : (uint64_t)later - period;
        else
            a->first_trigger = at > now() ? at - (at - now() - 1) / period * period : at + ((now() - at) / period + 1) * period;
        a->period = period;
    }
    a->in_step = steps;
    plan(unit);
}

void adc_trigger_changed(void)
{
    for (unsigned i = 0; i < UNITS; i++)
        update_step(i);
}

void adc_dma_changed(void)
{
    for (unsigned i = 0; i < UNITS; i++)
        plan(i);
}

/* ---- conversions by software --------------------------------------------------------------------------- */

static void start_single(unsigned unit)
{
    struct adc *a = &adcs[unit];
    if (a->sqr[0] & 15u || a->cfgr & CONT || a->cr & JADSTART)
        fault("ADC%u: sequences, continuous conversion and a turn by software are not modelled", unit + 1);
    event_at(&a->done, now() + conversion_ticks(a, first_channel(a)));
}

static void single_done(void *arg)
{
    struct adc *a = arg;
    unsigned unit = (unsigned)(a - adcs);
    int pin = check_input(unit, first_channel(a));
    a->cr &= ~(uint32_t)ADSTART;
    if (a->isr & EOC && !(a->cfgr & OVRMOD))
        a->isr |= OVR;
    if (pin >= 0)
        a->dr = board.adc_read(board.ctx, (uint32_t)pin, now()) & 0xfffu;
    a->isr |= EOC | EOS | EOSMP;
    if (a->cfgr & DMAEN && dma_enabled(dma_channel(unit)))
        dma_request(dma_channel(unit));
    update_line();
}

/* ---- injected conversions by software ------------------------------------------------------------------- */

/* RM0364, injected channel management: the injected conversion aborts a regular one, and one triggered meanwhile waits. Either moves a
 * sample of the bridge, which must not happen. */
static void check_gap(unsigned unit, uint64_t ticks)
{
    struct adc *a = &adcs[unit];
    if (!a->in_step)
        return;
    sync(unit);
    uint64_t since = (now() + a->period - a->first_trigger % a->period) % a->period;
    if (since < conversion_ticks(a, first_channel(a)) || since + ticks > a->period)
        fault("ADC%u: an injected conversion meets one in step with the bridge, %u of %u ticks after its trigger", unit + 1,
              (unsigned)since, a->period);
}

static void start_injected(unsigned unit)
{
    struct adc *a = &adcs[unit];
    unsigned channel = a->jsqr >> 8 & 31u;
    if (!(a->cr & ADEN) || a->ready_at)
        fault("ADC%u: JADSTART before ADRDY", unit + 1);
    if (!channel)
        fault("ADC%u: JADSTART without anything in JSQR", unit + 1);
    if (a->done.due != NEVER)
        fault("ADC%u: an injected conversion within one by software is not modelled", unit + 1);
    uint64_t ticks = conversion_ticks(a, channel);
    check_gap(unit, ticks);
    a->cr |= JADSTART;
    event_at(&a->injected, now() + ticks);
}

static void stop_injected(struct adc *a)
{
    a->cr &= ~(uint32_t)(JADSTART | JADSTP);
    event_at(&a->injected, NEVER);
}

static void injected_done(void *arg)
{
    struct adc *a = arg;
    int pin = check_input((unsigned)(a - adcs), a->jsqr >> 8 & 31u);
    stop_injected(a);
    if (pin >= 0)
        a->jdr = board.adc_read(board.ctx, (uint32_t)pin, now()) & 0xfffu;
    a->isr |= JEOC | JEOS;
    update_line();
}

static void jsqr_write(unsigned unit, uint32_t value)
{
    if (!(adcs[unit].cr & ADEN))
        fault("ADC%u_JSQR is written while the converter is off", unit + 1);
    /* sequences and triggers are not modelled, and so neither is the queue of contexts */
    must_be(unit ? "ADC2" : "ADC1", "JSQR", value, 31u << 8);
    adcs[unit].jsqr = value;
}

/* ---- registers ------------------------------------------------------------------------------------------- */

static void refresh(struct adc *a)
{
    if (a->cr & ADCAL && now() >= a->calibrated_at && !mutation.adc_dead) {
        a->cr &= ~(uint32_t)ADCAL;
        a->calibrated = 1;
        a->calfact = 0x40u;
    }
    if (a->cr & ADEN && now() >= a->ready_at && a->ready_at && !mutation.adc_dead) {
        a->isr |= ADRDY;
        a->ready_at = 0;
    }
}

static void check_off(unsigned unit, const char *reg)
{
    if (adcs[unit].cr & (ADSTART | JADSTART))
        fault("ADC%u_%s is written while conversions run (ADSTART or JADSTART is set)", unit + 1, reg);
}

static uint32_t unit_read(unsigned unit, uint32_t offset)
{
    struct adc *a = &adcs[unit];
    refresh(a);
    switch (offset) {
    case ISR:
        sync(unit);
        return a->isr;
    case IER:
        return a->ier;
    case CR:
        return a->cr;
    case CFGR:
        return a->cfgr;
    case SMPR1:
    case SMPR2:
        return a->smpr[(offset - SMPR1) / 4];
    case DR:
        sync(unit);
        a->isr &= ~(uint32_t)EOC;
        update_line();
        return a->dr;
    case JSQR:
        return a->jsqr;
    case JDR1:
        a->isr &= ~(uint32_t)JEOC;
        update_line();
        return a->jdr;
    case DIFSEL:
        return a->difsel;
    case CALFACT:
        return a->calfact;
    default:
        if (offset >= TR1 && offset <= TR3)
            return a->tr[(offset - TR1) / 4];
        if (offset >= SQR1 && offset <= SQR4)
            return a->sqr[(offset - SQR1) / 4];
        if (offset >= OFR1 && offset <= OFR4)
            return a->ofr[(offset - OFR1) / 4];
        return unmodelled_read(unit ? "ADC2" : "ADC1", offset);
    }
}

static void regulator_write(unsigned unit, uint32_t value)
{
    struct adc *a = &adcs[unit];
    uint32_t now_bits = value >> 28 & 3u, was = a->cr >> 28 & 3u;
    if (now_bits == was)
        return;
    if (now_bits == 1 && was != 0)
        fault("ADC%u: the regulator goes from %u to enabled; the way is over 0 (RM0364, 13.3.6)", unit + 1, was);
    if (now_bits == 2 && was != 0)
        fault("ADC%u: the regulator goes from %u to disabled; the way is over 0", unit + 1, was);
    if (now_bits == 1)
        a->regulator_at = now() + REGULATOR_TICKS;
    a->cr = (a->cr & ~0x30000000u) | now_bits << 28;
}

static int regulated(unsigned unit, const char *what)
{
    struct adc *a = &adcs[unit];
    if ((a->cr >> 28 & 3u) != 1 || now() < a->regulator_at) {
        fault("ADC%u %s before its regulator is up: 10 us after ADVREGEN = 01 (RM0364, 13.3.6)", unit + 1, what);
        return 0;
    }
    if (!clock_hz()) {
        fault("ADC%u %s without a clock: neither CKMODE nor ADC12PRES gives one", unit + 1, what);
        return 0;
    }
    return 1;
}

static void calibrate(unsigned unit, uint32_t value)
{
    struct adc *a = &adcs[unit];
    if (!regulated(unit, "is calibrated"))
        return;
    if (a->cr & ADEN)
        fault("ADC%u is calibrated while it is on (RM0364, 13.3.8)", unit + 1);
    if (mutation.adc_uncalibrated)
        return; /* the bit does not stay set: nothing is calibrated */
    a->cr |= value & (ADCAL | 1u << 30);
    a->calibrated_at = now() + (uint64_t)ticks_of(CALIBRATION_CYCLES, clock_hz()) + 1;
}

static void enable(unsigned unit)
{
    struct adc *a = &adcs[unit];
    if (!regulated(unit, "is switched on"))
        return;
    if (a->cr & ADCAL)
        fault("ADC%u is switched on while it calibrates", unit + 1);
    if (!a->calibrated)
        fault("ADC%u is switched on without having been calibrated", unit + 1);
    else if (now() < a->calibrated_at + (uint64_t)ticks_of(4, clock_hz()))
        fault("ADC%u: ADEN within four ADC clock cycles after the calibration's end (RM0364, 13.3.8)", unit + 1);
    a->cr |= ADEN;
    a->ready_at = now() + (uint64_t)ticks_of(2, clock_hz()) + 72;
}

static void start(unsigned unit)
{
    struct adc *a = &adcs[unit];
    if (!(a->cr & ADEN) || a->ready_at)
        fault("ADC%u: ADSTART before ADRDY", unit + 1);
    a->cr |= ADSTART;
    if (a->cfgr >> 10 & 3u)
        update_step(unit);
    else
        start_single(unit);
}

static void stop(unsigned unit)
{
    struct adc *a = &adcs[unit];
    sync(unit);
    a->cr &= ~(uint32_t)(ADSTART | ADSTP);
    event_at(&a->done, NEVER);
    update_step(unit);
}

static void cr_write(unsigned unit, uint32_t value)
{
    struct adc *a = &adcs[unit];
    refresh(a);
    regulator_write(unit, value);
    if (value & ADCAL && !(a->cr & ADCAL))
        calibrate(unit, value);
    if (value & ADEN && !(a->cr & ADEN))
        enable(unit);
    if (value & ADSTP && a->cr & ADSTART)
        stop(unit);
    if (value & JADSTP)
        stop_injected(a);
    if (value & ADDIS && a->cr & ADEN) {
        if (a->cr & (ADSTART | JADSTART))
            fault("ADC%u is switched off while conversions run", unit + 1);
        a->cr &= ~(uint32_t)ADEN;
        a->isr &= ~(uint32_t)ADRDY;
        a->calibrated = 1;
    }
    if (value & ADSTART && !(value & ADSTP) && !(a->cr & ADSTART))
        start(unit);
    if (value & JADSTART && !(value & JADSTP) && !(a->cr & JADSTART))
        start_injected(unit);
}

static void cfgr_write(unsigned unit, uint32_t value)
{
    check_off(unit, "CFGR");
    /* injected, discontinuous, auto-delay, watchdogs and the resolution below 12 bits are not modelled */
    must_be(unit ? "ADC2" : "ADC1", "CFGR", value, DMAEN | DMACFG | 0x3c0u | 0xc00u | OVRMOD | CONT);
    adcs[unit].cfgr = value;
}

static void unit_write(unsigned unit, uint32_t offset, uint32_t value)
{
    struct adc *a = &adcs[unit];
    switch (offset) {
    case ISR:
        refresh(a);
        sync(unit);
        a->isr &= ~(value & 0x7ffu);
        break;
    case IER:
        a->ier = value & 0x7ffu;
        break;
    case CR:
        cr_write(unit, value);
        break;
    case CFGR:
        cfgr_write(unit, value);
        break;
    case SMPR1:
    case SMPR2:
        check_off(unit, "SMPR");
        a->smpr[(offset - SMPR1) / 4] = value;
        break;
    case JSQR:
        jsqr_write(unit, value);
        break;
    case DIFSEL:
        if (value)
            fault("ADC%u: differential inputs are not modelled", unit + 1);
        break;
    case CALFACT:
        a->calfact = value;
        break;
    default:
        if (offset >= SQR1 && offset <= SQR4) {
            check_off(unit, "SQR");
            a->sqr[(offset - SQR1) / 4] = value;
        } else {
            unmodelled_write(unit ? "ADC2" : "ADC1", offset, value);
        }
    }
    update_line();
}

uint32_t adc_read_register(unsigned unit, uint32_t offset)
{
    (void)unit;
    if (offset == COMMON_CCR)
        return common_ccr;
    if (offset == COMMON_CSR)
        return (unit_read(0, ISR) & 0x7ffu) | (unit_read(1, ISR) & 0x7ffu) << 16;
    if (offset < 0x200)
        return unit_read(offset >> 8, offset & 0xffu);
    return unmodelled_read("ADC", offset);
}

void adc_write_register(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    if (offset == COMMON_CCR) {
        must_be("ADC", "CCR", value, 0x30000u | 7u << 22);
        if ((adcs[0].cr | adcs[1].cr) & (ADEN | ADCAL) && value != common_ccr)
            fault("the ADC clock (CKMODE) or an internal channel is changed while a converter is on (RM0364, 13.3.3)");
        if ((value >> 16 & 3u) == 1 && clocks.hclk == 0)
            fault("ADC CKMODE = 01 needs an undivided AHB clock");
        if (value & ~common_ccr & TSEN)
            sensor_at = now() + SENSOR_START_TICKS;
        common_ccr = value;
    } else if (offset < 0x200) {
        unit_write(offset >> 8, offset & 0xffu, value);
    } else {
        unmodelled_write("ADC", offset, value);
    }
}

void adc_reset(unsigned unit)
{
    (void)unit;
    common_ccr = 0;
    for (unsigned i = 0; i < UNITS; i++) {
        struct adc *a = &adcs[i];
        struct event done = a->done, injected = a->injected, dma = a->dma;
        memset(a, 0, sizeof *a);
        a->cr = 0x20000000u;
        a->done = done;
        a->injected = injected;
        a->dma = dma;
        a->done.run = single_done;
        a->injected.run = injected_done;
        a->dma.run = dma_due;
        a->done.arg = a->injected.arg = a->dma.arg = a;
        event_at(&a->done, NEVER);
        event_at(&a->injected, NEVER);
        event_at(&a->dma, NEVER);
    }
}
