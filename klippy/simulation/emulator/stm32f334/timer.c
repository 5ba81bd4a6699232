/* General purpose timers TIM1, 2, 3, 6, 7, 15, 16, 17 (RM0364 chapters 17 to 20): up-counters, compare interrupts, PWM.
 *
 * A counter is a start clock and a rate; flags are computed when they are read or when an enabled interrupt is due.
 */
#include "chip.h"

#include <string.h>

enum {
    CR1 = 0x00, CR2 = 0x04, SMCR = 0x08, DIER = 0x0c, SR = 0x10, EGR = 0x14, CCMR1 = 0x18, CCMR2 = 0x1c, CCER = 0x20,
    CNT = 0x24, PSC = 0x28, ARR = 0x2c, RCR = 0x30, CCR1 = 0x34, CCR4 = 0x40, BDTR = 0x44,
    UNITS = 8, CHANNELS = 4, CEN = 1, URS = 4, UIF = 1, MOE = 1 << 15, WORLD_PWM_MAX = 255,
};

static struct timer {
    uint32_t cr1, cr2, dier, sr, ccmr[2], ccer, psc, arr, ccr[CHANNELS], bdtr;
    uint64_t counted;   /* counts so far, of which CNT is the rest modulo ARR + 1 */
    uint64_t base, at;  /* the count there was at clock `at`, when the rate was last changed */
    struct event due;
    uint8_t sent[CHANNELS]; /* a PWM value has been sent to the world */
    uint32_t sent_value[CHANNELS], sent_cycle[CHANNELS];
} timers[UNITS];

static const struct { const char *name; unsigned irq, irq_compare, bits, channels, apb2, has_moe; } FIXED[UNITS] = {
    { "TIM2", IRQ_TIM2, IRQ_TIM2, 32, 4, 0, 0 },
    { "TIM3", IRQ_TIM3, IRQ_TIM3, 16, 4, 0, 0 },
    { "TIM6", IRQ_TIM6, IRQ_TIM6, 16, 0, 0, 0 },
    { "TIM7", IRQ_TIM7, IRQ_TIM7, 16, 0, 0, 0 },
    { "TIM1", IRQ_TIM1_UP_TIM16, IRQ_TIM1_CC, 16, 4, 1, 1 },
    { "TIM15", IRQ_TIM1_BRK_TIM15, IRQ_TIM1_BRK_TIM15, 16, 2, 1, 1 },
    { "TIM16", IRQ_TIM1_UP_TIM16, IRQ_TIM1_UP_TIM16, 16, 1, 1, 1 },
    { "TIM17", IRQ_TIM1_TRG_TIM17, IRQ_TIM1_TRG_TIM17, 16, 1, 1, 1 },
};

/* Pins of the channels (DS9994 table 14): unit, channel from 0, pin, alternate function. */
static const struct { uint8_t unit, channel, pin, function; } PINS[] = {
    { 0, 0, 0, 1 },   { 0, 0, 5, 1 },  { 0, 0, 15, 1 }, { 0, 1, 1, 1 },   { 0, 1, 19, 1 },  { 0, 2, 2, 1 },  { 0, 2, 9, 10 },
    { 0, 2, 26, 1 },  { 0, 3, 3, 1 },  { 0, 3, 10, 10 }, { 0, 3, 27, 1 }, { 1, 0, 6, 2 },   { 1, 0, 20, 2 }, { 1, 0, 38, 2 },
    { 1, 1, 4, 2 },   { 1, 1, 7, 2 },  { 1, 1, 21, 2 }, { 1, 1, 39, 2 },  { 1, 2, 16, 2 },  { 1, 2, 40, 2 }, { 1, 3, 17, 2 },
    { 1, 3, 23, 10 }, { 1, 3, 41, 2 }, { 4, 0, 8, 6 },  { 4, 0, 32, 2 },  { 4, 1, 9, 6 },   { 4, 1, 33, 2 }, { 4, 2, 10, 6 },
    { 4, 2, 34, 2 },  { 4, 3, 11, 11 }, { 4, 3, 35, 2 }, { 5, 0, 2, 9 },  { 5, 0, 30, 1 },  { 5, 1, 3, 9 },  { 5, 1, 31, 1 },
    { 6, 0, 6, 1 },   { 6, 0, 12, 1 }, { 6, 0, 20, 1 }, { 6, 0, 24, 1 },  { 7, 0, 7, 1 },   { 7, 0, 21, 10 }, { 7, 0, 25, 1 },
};

static uint32_t clock_hz(unsigned unit)
{
    return FIXED[unit].apb2 ? clocks.timer2 : clocks.timer1;
}

static uint64_t count_at(unsigned unit, uint64_t clock)
{
    const struct timer *t = &timers[unit];
    return t->base + (uint64_t)((unsigned __int128)(clock - t->at) * clock_hz(unit) / ((uint64_t)CORE_TICK_HZ * (t->psc + 1)));
}

/* The first clock at which the count is reached. */
static uint64_t clock_of(unsigned unit, uint64_t count)
{
    const struct timer *t = &timers[unit];
    uint64_t hz = clock_hz(unit);
    return t->at + (uint64_t)(((unsigned __int128)(count - t->base) * CORE_TICK_HZ * (t->psc + 1) + hz - 1) / hz);
}

static void rebase(unsigned unit, uint64_t count)
{
    timers[unit].base = timers[unit].counted = count;
    timers[unit].at = now();
}

static uint64_t length(unsigned unit)
{
    return (uint64_t)timers[unit].arr + 1;
}

static void update_lines(unsigned unit)
{
    /* TIM1's update shares its line with TIM16, so both are looked at. */
    uint32_t up = 0, compare = 0;
    for (unsigned i = 0; i < UNITS; i++) {
        uint32_t on = timers[i].sr & timers[i].dier & 0x5fu;
        if (FIXED[i].irq == FIXED[unit].irq)
            up |= FIXED[i].irq == FIXED[i].irq_compare ? on : on & 1u;
        if (FIXED[i].irq_compare == FIXED[unit].irq_compare)
            compare |= FIXED[i].irq == FIXED[i].irq_compare ? on : on & ~1u;
    }
    nvic_line(FIXED[unit].irq, up != 0 && !(unit == 0 && mutation.compare_dead));
    if (FIXED[unit].irq_compare != FIXED[unit].irq)
        nvic_line(FIXED[unit].irq_compare, compare != 0);
}

/* The first count after `from` at which the counter is at `value`. */
static uint64_t next_match(unsigned unit, uint64_t from, uint32_t value)
{
    uint64_t n = length(unit), rest = from % n;
    return value > rest ? from + (value - rest) : from + (n - rest) + value;
}

/* Count up to now and note what has happened on the way. */
static void sync(unsigned unit)
{
    struct timer *t = &timers[unit];
    if (!(t->cr1 & CEN))
        return;
    uint64_t before = t->counted;
    t->counted = count_at(unit, now());
    if (t->counted == before)
        return;
    if (next_match(unit, before, 0) <= t->counted)
        t->sr |= UIF;
    for (unsigned i = 0; i < FIXED[unit].channels; i++)
        if (t->ccr[i] <= t->arr && next_match(unit, before, t->ccr[i]) <= t->counted)
            t->sr |= 2u << i;
}

void timer_before_clock_change(void)
{
    for (unsigned unit = 0; unit < UNITS; unit++)
        if (timers[unit].cr1 & CEN) {
            sync(unit);
            rebase(unit, timers[unit].counted);
        }
}

static void plan(unsigned unit)
{
    struct timer *t = &timers[unit];
    uint64_t count = UINT64_MAX;
    if (t->cr1 & CEN) {
        if (t->dier & 1u)
            count = next_match(unit, t->counted, 0);
        for (unsigned i = 0; i < FIXED[unit].channels; i++)
            if (t->dier >> (i + 1) & 1u && t->ccr[i] <= t->arr) {
                uint64_t match = next_match(unit, t->counted, t->ccr[i]);
                count = match < count ? match : count;
            }
    }
    event_at(&t->due, count == UINT64_MAX ? NEVER : clock_of(unit, count));
}

static void match_due(void *arg)
{
    unsigned unit = (unsigned)((struct timer *)arg - timers);
    sync(unit);
    plan(unit);
    update_lines(unit);
}

/* ---- PWM: only the mean of a pin matters to the world, so it hears duty and period ------------------------- */

static int channel_pwm(const struct timer *t, unsigned channel)
{
    uint32_t mode = t->ccmr[channel / 2] >> (8 * (channel & 1u) + 4) & 7u;
    return mode == 6 ? 1 : mode == 7 ? -1 : 0;
}

static void send_pwm(unsigned unit)
{
    struct timer *t = &timers[unit];
    for (unsigned i = 0; i < sizeof PINS / sizeof *PINS; i++) {
        unsigned c = PINS[i].channel;
        if (PINS[i].unit != unit || gpio_function(PINS[i].pin) != PINS[i].function)
            continue;
        int on = t->cr1 & CEN && t->ccer >> 4 * c & 1u && (!FIXED[unit].has_moe || t->bdtr & MOE);
        int sense = channel_pwm(t, c);
        uint64_t high = t->ccr[c] < length(unit) ? t->ccr[c] : length(unit);
        if (sense * (t->ccer >> (4 * c + 1) & 1u ? -1 : 1) < 0)
            high = length(unit) - high;
        uint32_t value = on && sense ? (uint32_t)((high * WORLD_PWM_MAX + length(unit) / 2) / length(unit)) : 0;
        if (on && !sense)
            fault("%s channel %u drives pin P%c%u in a mode that is not PWM", FIXED[unit].name, c + 1, 'A' + PINS[i].pin / 16,
                  PINS[i].pin % 16u);
        uint32_t cycle = (uint32_t)ticks_of((uint32_t)(length(unit) * (t->psc + 1)), clock_hz(unit));
        if (t->sent[c] && t->sent_value[c] == value && t->sent_cycle[c] == cycle)
            continue;
        t->sent[c] = 1;
        t->sent_value[c] = value;
        t->sent_cycle[c] = cycle;
        board.pwm_write(board.ctx, PINS[i].pin, cycle, value, now());
    }
}

void timer_pin_changed(unsigned pin)
{
    for (unsigned i = 0; i < sizeof PINS / sizeof *PINS; i++)
        if (PINS[i].pin == pin && timers[PINS[i].unit].cr1 & CEN) {
            timers[PINS[i].unit].sent[PINS[i].channel] = 0;
            send_pwm(PINS[i].unit);
        }
}

/* ---- registers ------------------------------------------------------------------------------------------------- */

uint32_t timer_read(unsigned unit, uint32_t offset)
{
    struct timer *t = &timers[unit];
    sync(unit);
    switch (offset) {
    case CR1:
        return t->cr1;
    case CR2:
        return t->cr2;
    case SMCR:
    case EGR:
    case RCR:
        return 0;
    case DIER:
        return t->dier;
    case SR:
        return t->sr;
    case CCMR1:
    case CCMR2:
        return t->ccmr[(offset - CCMR1) / 4];
    case CCER:
        return t->ccer;
    case CNT:
        return (uint32_t)(t->counted % length(unit));
    case PSC:
        return t->psc;
    case ARR:
        return t->arr;
    case BDTR:
        return t->bdtr;
    default:
        if (offset >= CCR1 && offset <= CCR4)
            return t->ccr[(offset - CCR1) / 4];
        return unmodelled_read(FIXED[unit].name, offset);
    }
}

static void cr1_write(unsigned unit, uint32_t value)
{
    struct timer *t = &timers[unit];
    must_be(FIXED[unit].name, "CR1", value, 0x87u);
    rebase(unit, t->counted);
    t->cr1 = value;
}

static void set_count(unsigned unit, uint32_t value)
{
    rebase(unit, value % length(unit));
}

static void ccmr_write(unsigned unit, unsigned i, uint32_t value)
{
    if (value & 0x0303u)
        fault("%s: input capture is not modelled (CCMR%u = 0x%x)", FIXED[unit].name, i + 1, value);
    timers[unit].ccmr[i] = value;
}

static void update_event(unsigned unit, uint32_t value)
{
    struct timer *t = &timers[unit];
    if (value & ~1u)
        fault("%s: EGR = 0x%x: only the update event is modelled", FIXED[unit].name, value);
    if (!(value & 1u))
        return;
    set_count(unit, 0);
    if (!(t->cr1 & URS))
        t->sr |= UIF;
}

static void register_write(unsigned unit, uint32_t offset, uint32_t value)
{
    struct timer *t = &timers[unit];
    switch (offset) {
    case CR1:
        cr1_write(unit, value);
        return;
    case CR2:
        must_be(FIXED[unit].name, "CR2", value, 0x70u);
        t->cr2 = value;
        return;
    case DIER:
        must_be(FIXED[unit].name, "DIER", value, 0x1fu);
        t->dier = value;
        return;
    case SR:
        t->sr &= value;
        return;
    case EGR:
        update_event(unit, value);
        return;
    case CCMR1:
    case CCMR2:
        ccmr_write(unit, (offset - CCMR1) / 4, value);
        return;
    case CCER:
        must_be(FIXED[unit].name, "CCER", value, 0x3333u);
        t->ccer = value;
        return;
    case CNT:
        set_count(unit, value);
        return;
    case PSC:
        rebase(unit, t->counted);
        t->psc = value & 0xffffu;
        return;
    case ARR:
        rebase(unit, t->counted % length(unit));
        t->arr = FIXED[unit].bits == 32 ? value : value & 0xffffu;
        return;
    case BDTR:
        must_be(FIXED[unit].name, "BDTR", value, MOE | 0x0c00u);
        t->bdtr = value;
        return;
    default:
        if (offset >= CCR1 && offset <= CCR4)
            t->ccr[(offset - CCR1) / 4] = FIXED[unit].bits == 32 ? value : value & 0xffffu;
        else if (value || (offset != SMCR && offset != RCR))
            unmodelled_write(FIXED[unit].name, offset, value);
    }
}

void timer_write(unsigned unit, uint32_t offset, uint32_t value)
{
    sync(unit);
    register_write(unit, offset, value);
    plan(unit);
    update_lines(unit);
    if (FIXED[unit].channels && timers[unit].ccer & 0x1111u)
        send_pwm(unit);
}

void timer_reset(unsigned unit)
{
    struct timer *t = &timers[unit];
    struct event due = t->due;
    memset(t, 0, sizeof *t);
    t->arr = FIXED[unit].bits == 32 ? 0xffffffffu : 0xffffu;
    t->due = due;
    t->due.run = match_due;
    t->due.arg = t;
    event_at(&t->due, NEVER);
}
