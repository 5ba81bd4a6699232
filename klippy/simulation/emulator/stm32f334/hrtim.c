/* HRTIM registers, preload and update (RM0364 chapter 21); outputs and faults in hrtim_outputs.c.
 *
 * The counters are not stepped: a period edge is an event only while something waits for it. What the model
 * does not have (burst mode, external events, captures, push-pull, chopper, interrupts of the timers) it refuses.
 */
#include "chip.h"
#include "hrtim.h"

#include <string.h>

enum {
    CR = 0x00, ISR = 0x04, ICR = 0x08, DIER = 0x0c, CNTR = 0x10, PERR = 0x14, REPR = 0x18, CMP1 = 0x1c, CMP1C = 0x20,
    CMP2 = 0x24, CMP4 = 0x2c, DTR = 0x38, SET1 = 0x3c, RST2 = 0x48, EEF1 = 0x4c, EEF2 = 0x50, RSTR = 0x54, CHPR = 0x58,
    OUTR = 0x64, FLTR = 0x68,
    COMMON = 0x380, CR1 = 0x00, CR2 = 0x04, C_ISR = 0x08, C_ICR = 0x0c, IER = 0x10, OENR = 0x14, ODISR = 0x18, ODSR = 0x1c,
    BMCR = 0x20, ADC1R = 0x3c, ADC4R = 0x48, DLLCR = 0x4c, FLTINR1 = 0x50, FLTINR2 = 0x54,
    PREEN = 1u << 27, UPD = 1u << 6, REP = 1u << 4, DLLRDY = 1u << 16, SYSFLT = 1u << 5,
    DLL_TICKS = 1024, /* 14.2 us: 2048 periods of 144 MHz */
};

struct hr_timer hr[HR_TIMERS];

struct hr_common h;

static void update_due(void *arg);

static uint64_t steps_per_tick(void)
{
    return (uint64_t)clocks.hrtim * 32u / CORE_TICK_HZ;
}

static uint64_t hr_now(void)
{
    return now() * steps_per_tick();
}

static uint64_t to_clock(uint64_t steps)
{
    return (steps + steps_per_tick() - 1) / steps_per_tick();
}

int hr_dll_ready(void)
{
    return h.dll_at && now() >= h.dll_at && !mutation.no_dll;
}

/* ---- preload and update ---------------------------------------------------------------------------------- */

static int waits(unsigned timer)
{
    return hr[timer].cr & PREEN && memcmp(&hr[timer].pre, &hr[timer].active, sizeof hr[timer].pre) != 0;
}

static uint64_t next_zero(unsigned timer)
{
    uint32_t period;
    uint64_t zero;
    if (!hr[timer].running || hr_phase_of(timer, &period, &zero) || !period)
        return NEVER;
    uint64_t present = hr_now();
    return present < zero ? to_clock(zero) : to_clock(zero + ((present - zero) / period + 1) * period);
}

/* Clock at which the timer takes over its preloaded values, NEVER if nothing makes it. */
static uint64_t update_clock(unsigned timer)
{
    const struct hr_timer *t = &hr[timer];
    if (h.cr1 >> timer & 1u)
        return NEVER; /* updates are held (xUDIS) */
    uint64_t due = NEVER;
    if (timer == HR_MASTER)
        return t->cr & 1u << 29 ? next_zero(HR_MASTER) : NEVER;
    if (t->cr & (1u << 17 | 1u << 18)) /* own repetition, own reset or roll-over */
        due = next_zero(timer);
    if (t->cr & 1u << 24 && !(h.cr1 & 1u)) { /* the master's update */
        uint64_t master = hr[HR_MASTER].cr & 1u << 29 ? next_zero(HR_MASTER) : NEVER;
        due = master < due ? master : due;
    }
    for (unsigned other = 1; other < HR_TIMERS; other++) /* other timers' updates: bits 19 (A) to 23 (E) */
        if (other != timer && t->cr >> (18 + other) & 1u && hr[other].cr & (1u << 17 | 1u << 18)
            && !(h.cr1 >> other & 1u)) {
            uint64_t theirs = next_zero(other);
            due = theirs < due ? theirs : due;
        }
    return due;
}

static uint64_t planned[HR_TIMERS];

static void plan(void)
{
    uint64_t first = NEVER;
    for (unsigned t = 0; t < HR_TIMERS; t++) {
        planned[t] = waits(t) ? update_clock(t) : NEVER;
        first = planned[t] < first ? planned[t] : first;
    }
    event_at(&h.update, first);
}

static void take_over(unsigned timer)
{
    adc_before_change(); /* what was sampled until now was sampled under the old values */
    hr[timer].active = hr[timer].pre;
    hr[timer].isr |= UPD;
}

static void update_due(void *arg)
{
    (void)arg;
    for (unsigned t = 0; t < HR_TIMERS; t++)
        if (planned[t] <= now())
            take_over(t);
    hr_evaluate();
    adc_trigger_changed();
    plan();
}

static void changed(unsigned timer)
{
    if (!(hr[timer].cr & PREEN)) {
        take_over(timer);
        hr_evaluate();
        adc_trigger_changed();
    }
    plan();
}

int hrtim_adc_trigger(unsigned number, uint32_t *period_ticks, uint64_t *at)
{
    uint32_t sources = h.adc[number - 1], period = 0;
    uint64_t zero = 0;
    if (!sources)
        return 0;
    if (sources & (sources - 1)) {
        fault("HRTIM: more than one source of ADC trigger %u (0x%x) is not modelled", number, sources);
        return 0;
    }
    unsigned bit = (unsigned)__builtin_ctz(sources), timer, compare;
    if (bit <= 4) {
        timer = HR_MASTER;
        compare = bit == 4 ? 0 : bit + 1;
    } else if (bit >= 10 && bit <= 19) {
        timer = bit < 15 ? 1 : 2;
        compare = (bit - 10) % 5 < 3 ? (bit - 10) % 5 + 2 : 0;
    } else {
        fault("HRTIM: ADC trigger %u from a source that is not modelled (0x%x)", number, sources);
        return 0;
    }
    if (!hr[timer].running || hr_phase_of(timer, &period, &zero))
        return 0;
    uint32_t offset = compare ? hr[timer].active.cmp[compare - 1] << (hr[timer].cr & 7u) : 0;
    if (offset > period || period % steps_per_tick())
        return 0;
    *period_ticks = (uint32_t)(period / steps_per_tick());
    *at = to_clock(zero + offset);
    return 1;
}

/* ---- registers --------------------------------------------------------------------------------------------------- */

static void refresh(void)
{
    if (hr_dll_ready())
        h.isr |= DLLRDY;
}

static uint32_t counter(unsigned timer)
{
    uint32_t period;
    uint64_t zero;
    if (!hr[timer].running || hr_phase_of(timer, &period, &zero) || !period || hr_now() < zero)
        return 0;
    return (uint32_t)((hr_now() - zero) % period >> (hr[timer].cr & 7u));
}

static uint32_t timer_register(unsigned timer, uint32_t offset)
{
    const struct hr_timer *t = &hr[timer];
    switch (offset) {
    case CR:
        return t->cr;
    case ISR:
        return t->isr | (timer && hr_leg_on(timer) ? 3u << 18 : 0);
    case DIER:
        return t->dier;
    case CNTR:
        return counter(timer);
    case PERR:
        return t->pre.per;
    case REPR:
        return t->pre.rep;
    case CMP1:
        return t->pre.cmp[0];
    case DTR:
        return t->pre.dead_time;
    case EEF1:
    case EEF2:
    case CHPR:
        return 0;
    case RSTR:
        return t->pre.counter_reset;
    case OUTR:
        return t->outr;
    case FLTR:
        return t->fltr;
    default:
        if (offset >= CMP2 && offset <= CMP4)
            return t->pre.cmp[1 + (offset - CMP2) / 4];
        if (offset >= SET1 && offset <= RST2)
            return (offset - SET1) & 4u ? t->pre.reset[(offset - SET1) / 8] : t->pre.set[(offset - SET1) / 8];
        return unmodelled_read("HRTIM timer", offset);
    }
}

static void control_write(unsigned timer, uint32_t value)
{
    struct hr_timer *t = &hr[timer];
    if (timer == HR_MASTER) {
        must_be("HRTIM", "MCR", value, 0x283f002fu);
        for (unsigned i = 0; i < HR_TIMERS; i++) {
            int on = (int)(value >> (16 + i) & 1u);
            if (on && !hr[i].running) {
                hr[i].zero = hr_now();
                if (!hr_dll_ready())
                    fault("HRTIM: a counter is started before the delay line is calibrated (DLLRDY is 0; RM0364, 21.3.4)");
                if (!((i ? hr[i].cr : value) & 8u))
                    fault("HRTIM: single-shot counters are not modelled (CONT is 0)");
            }
            hr[i].running = on && !mutation.hrtim_dead;
        }
    } else {
        must_be("HRTIM", "TIMxCR", value, 0x09ff002fu);
    }
    if (t->running && (value ^ t->cr) & 7u)
        fault("HRTIM: the prescaler (CKPSC) is changed while the counter runs");
    t->cr = value;
    changed(timer);
    hr_evaluate();
    adc_trigger_changed();
}

static void output_write(unsigned timer, uint32_t value)
{
    struct hr_timer *t = &hr[timer];
    must_be("HRTIM", "OUTxR", value, 0x00ff01feu);
    if (h.enabled >> 2 * (timer - 1) & 3u && (value ^ t->outr) & 1u << 8)
        fault("HRTIM: DTEN is changed while outputs of the timer are on (RM0364, 21.5.35)");
    t->outr = value;
    hr_evaluate();
}

static void timer_register_write(unsigned timer, uint32_t offset, uint32_t value)
{
    struct hr_timer *t = &hr[timer];
    switch (offset) {
    case CR:
        control_write(timer, value);
        return;
    case ICR:
        t->isr &= ~value;
        return;
    case DIER:
        if (value)
            fault("HRTIM: interrupts and DMA requests of the timers are not modelled (DIER = 0x%x)", value);
        return;
    case PERR:
        if (value < 0x60 || value > 0xffdf)
            fault("HRTIM: a period of 0x%x; 0x60 to 0xffdf are allowed", value);
        t->pre.per = value;
        break;
    case REPR:
        if (value)
            fault("HRTIM: a repetition counter of %u is not modelled", value);
        break;
    case CMP1:
        t->pre.cmp[0] = value & 0xffffu;
        break;
    case CMP1C:
        t->pre.cmp[0] = value & 0xffffu;
        break;
    case DTR:
        if ((t->pre.dead_time & (1u << 15 | 1u << 31)) && value != t->pre.dead_time)
            fault("HRTIM: DTR is written after it has been locked");
        t->pre.dead_time = value;
        break;
    case RSTR:
        t->pre.counter_reset = value;
        break;
    case OUTR:
        output_write(timer, value);
        return;
    case FLTR:
        if (t->fltr & 1u << 31 && value != t->fltr)
            fault("HRTIM: FLTR is written after it has been locked");
        t->fltr = value;
        hrtim_fault_line();
        return;
    case EEF1:
    case EEF2:
    case CHPR:
        if (value)
            fault("HRTIM: external events and the chopper are not modelled (+ 0x%02x = 0x%x)", offset, value);
        return;
    default:
        if (offset >= CMP2 && offset <= CMP4)
            t->pre.cmp[1 + (offset - CMP2) / 4] = value & 0xffffu;
        else if (offset >= SET1 && offset <= RST2)
            *((offset - SET1) & 4u ? &t->pre.reset[(offset - SET1) / 8] : &t->pre.set[(offset - SET1) / 8]) = value;
        else {
            unmodelled_write("HRTIM timer", offset, value);
            return;
        }
    }
    changed(timer);
}

static uint32_t common_read(uint32_t offset)
{
    refresh();
    switch (offset) {
    case CR1:
        return h.cr1;
    case CR2:
    case ODISR:
        return 0;
    case C_ISR:
        return h.isr;
    case IER:
        return h.ier;
    case OENR:
        return h.enabled;
    case ODSR:
        return h.faulted;
    case BMCR:
        return 0;
    case DLLCR:
        return h.dllcr & ~1u;
    case FLTINR1:
    case FLTINR2:
        return h.fltinr[(offset - FLTINR1) / 4];
    default:
        if (offset >= ADC1R && offset <= ADC4R)
            return h.adc[(offset - ADC1R) / 4];
        return unmodelled_read("HRTIM common", offset);
    }
}

static void cr2_write(uint32_t value)
{
    must_be("HRTIM", "CR2", value, 0x3f3fu);
    for (unsigned t = 0; t < HR_TIMERS; t++) {
        if (value >> t & 1u)
            take_over(t);
        if (value >> (8 + t) & 1u)
            hr[t].zero = hr_now();
    }
    hr_evaluate();
    adc_trigger_changed();
    plan();
}

static void fltin_write(unsigned i, uint32_t value)
{
    uint32_t locked = h.fltinr[i] & 0x80808080u;
    for (unsigned b = 0; b < 4; b++)
        if (locked >> (8 * b + 7) & 1u && (value ^ h.fltinr[i]) >> 8 * b & 0xffu)
            fault("HRTIM: a fault input's set-up is written after it has been locked");
    if (i && value >> 24 && value >> 24 > 3)
        fault("HRTIM: FLTINR2 = 0x%x", value);
    h.fltinr[i] = value;
    hrtim_fault_line();
}

static void common_write(uint32_t offset, uint32_t value)
{
    refresh();
    switch (offset) {
    case CR1:
        must_be("HRTIM", "CR1", value, 0x0fff003fu);
        h.cr1 = value;
        plan();
        return;
    case CR2:
        cr2_write(value);
        return;
    case C_ICR:
        h.isr &= ~value;
        hrtim_fault_line(); /* what is still active shows again */
        return;
    case IER:
        h.ier = value;
        if (value & ~0x3fu)
            fault("HRTIM: only fault interrupts are modelled (IER = 0x%x)", value);
        hr_fault_irq();
        return;
    case OENR:
        hr_outputs_on(value);
        return;
    case ODISR:
        hr_outputs_off(value);
        return;
    case DLLCR:
        if (!h.dll_at && value & 3u)
            h.dll_at = now() + DLL_TICKS;
        h.dllcr = value;
        return;
    case FLTINR1:
    case FLTINR2:
        fltin_write((offset - FLTINR1) / 4, value);
        return;
    default:
        if (offset >= ADC1R && offset <= ADC4R) {
            h.adc[(offset - ADC1R) / 4] = value;
            adc_trigger_changed();
        } else if (value || (offset != BMCR && offset != 0x24)) {
            unmodelled_write("HRTIM common", offset, value);
        }
    }
}

uint32_t hrtim_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    if (offset >= COMMON)
        return common_read(offset - COMMON);
    return offset < 0x300 ? timer_register(offset >> 7, offset & 0x7fu) : unmodelled_read("HRTIM", offset);
}

void hrtim_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    if (offset >= COMMON)
        common_write(offset - COMMON, value);
    else if (offset < 0x300)
        timer_register_write(offset >> 7, offset & 0x7fu, value);
    else
        unmodelled_write("HRTIM", offset, value);
}

void hrtim_reset(unsigned unit)
{
    (void)unit;
    struct event update = h.update;
    if (h.sent && h.phase)
        board.bridge_set(board.ctx, 0, now()); /* pins float: the drivers' pull-downs open the switches */
    memset(hr, 0, sizeof hr);
    memset(&h, 0, sizeof h);
    for (unsigned t = 0; t < HR_TIMERS; t++)
        hr[t].pre.per = hr[t].active.per = 0xffdfu;
    h.update = update;
    h.update.run = update_due;
    event_at(&h.update, NEVER);
    for (unsigned t = 0; t < HR_TIMERS; t++)
        planned[t] = NEVER;
}

int hrtim_peek(const char *what, uint32_t *value)
{
    uint32_t period = 0;
    if (!strcmp(what, "outputs"))
        *value = h.enabled;
    else if (!strcmp(what, "faulted"))
        *value = h.faulted;
    else if (!strcmp(what, "phase"))
        *value = h.sent ? h.phase : 0;
    else if (!strcmp(what, "period"))
        *value = hr[1].active.per;
    else if (!strcmp(what, "lag") && hr_leg_on(1) && hr_leg_on(2))
        *value = (uint32_t)hr_lag(1, 2, &period);
    else
        return -1;
    return 0;
}
