/* What the HRTIM's outputs look like: from the set and reset events in force to pulses, from two legs to a phase.
 *
 * Nothing here knows how the firmware means its bridge: an output goes high at its set events and low at its reset
 * events, whatever their source, and the lag of one leg against the other is measured on the result.
 */
#include "chip.h"
#include "hrtim.h"

enum { EDGES_MAX = 16, MIN_COMPARE = 0x60 };

enum action { RESET, SET, TOGGLE };

struct edge {
    uint32_t at;
    enum action action;
};

static const char *const NAMES[HR_TIMERS] = { "the master timer", "timer A", "timer B", "timer C", "timer D", "timer E" };

static uint32_t scale(const struct hr_timer *t)
{
    return 1u << (t->cr & 7u);
}

static uint32_t compare(const struct hr_timer *t, unsigned number)
{
    uint32_t value = number == 1 && t->cr & 1u << 5 ? t->active.per / 2 : t->active.cmp[number - 1];
    return value * scale(t);
}

/* Where a counter-reset source of the timer lies against its source's zero; the source in *from. */
static int reset_source(unsigned timer, unsigned *from, uint32_t *offset)
{
    uint32_t sources = hr[timer].active.counter_reset;
    if (!sources)
        return 0;
    if (sources & (sources - 1)) {
        fault("HRTIM: %s is reset by more than one event, which is not modelled", NAMES[timer]);
        return -1;
    }
    unsigned bit = (unsigned)__builtin_ctz(sources);
    if (bit >= 4 && bit <= 8) {
        *from = HR_MASTER;
        *offset = bit == 4 ? 0 : compare(&hr[HR_MASTER], bit - 4);
        return 1;
    }
    if (bit >= 19 && bit <= 30) { /* the four other timers' compare 1, 2, 4, in order of their letters */
        unsigned other = 1 + (bit - 19) / 3;
        static const uint8_t COMPARE[3] = { 1, 2, 4 };
        *from = other >= timer ? other + 1 : other;
        *offset = compare(&hr[*from], COMPARE[(bit - 19) % 3]);
        return 1;
    }
    fault("HRTIM: %s is reset by an event that is not modelled (RSTR = 0x%x)", NAMES[timer], sources);
    return -1;
}

static int phase_of(unsigned timer, uint32_t *period, uint64_t *zero, int depth)
{
    const struct hr_timer *t = &hr[timer];
    *period = t->active.per * scale(t);
    *zero = t->zero;
    if (timer == HR_MASTER)
        return 0;
    unsigned from = 0;
    uint32_t offset = 0, source_period;
    uint64_t source_zero;
    int found = reset_source(timer, &from, &offset);
    if (found <= 0)
        return found;
    if (depth > 2 || phase_of(from, &source_period, &source_zero, depth + 1))
        return -1;
    if (offset > source_period)
        return 0; /* the event never comes: the timer runs freely */
    if (*period < source_period) {
        fault("HRTIM: %s has a period of %u steps and is reset every %u: it rolls over in between", NAMES[timer], *period,
              source_period);
        return -1;
    }
    *period = source_period;
    *zero = source_zero + offset;
    return 0;
}

int hr_phase_of(unsigned timer, uint32_t *period, uint64_t *zero)
{
    return phase_of(timer, period, zero, 0);
}

static uint32_t wrap(uint64_t from, uint64_t to, uint32_t period)
{
    return to >= from ? (uint32_t)((to - from) % period) : period - 1 - (uint32_t)((from - to - 1) % period);
}

static int add_compare(struct edge *edges, int n, unsigned source, unsigned number, uint64_t zero, uint32_t period,
                       enum action action)
{
    uint32_t source_period;
    uint64_t source_zero;
    if (hr_phase_of(source, &source_period, &source_zero))
        return -1;
    uint32_t value = number ? compare(&hr[source], number) : 0;
    if (number && value < MIN_COMPARE * scale(&hr[source])) {
        fault("HRTIM: compare %u of %s is 0x%x; at least 0x60, three periods of its clock, are needed (RM0364, 21.5.20)",
              number, NAMES[source], value);
        return -1;
    }
    if (source_period != period) {
        fault("HRTIM: an output follows %s, whose period is %u steps, and its own timer has %u", NAMES[source], source_period,
              period);
        return -1;
    }
    if (value > period)
        return n; /* never reached */
    edges[n] = (struct edge){ wrap(zero, source_zero + value, period), action };
    return n + 1;
}

/* All events of one crossbar register; returns the new count of edges or -1. */
static int add_sources(struct edge *edges, int n, unsigned timer, uint32_t sources, uint64_t zero, uint32_t period,
                       enum action action)
{
    for (uint32_t rest = sources & ~0x80000001u; rest && n >= 0 && n < EDGES_MAX; rest &= rest - 1) {
        unsigned bit = (unsigned)__builtin_ctz(rest);
        if (bit == 2)
            n = add_compare(edges, n, timer, 0, zero, period, action);
        else if (bit >= 3 && bit <= 6)
            n = add_compare(edges, n, timer, bit - 2, zero, period, action);
        else if (bit >= 7 && bit <= 11)
            n = add_compare(edges, n, HR_MASTER, bit - 7, zero, period, action);
        else if (timer == 2 && (bit == 12 || bit == 13)) /* table 82: timer B's events 1 and 2 are compare 1, 2 of A */
            n = add_compare(edges, n, 1, bit - 11, zero, period, action);
        else if (timer == 1 && (bit == 12 || bit == 13)) /* timer A's events 1 and 2 are compare 1 and 2 of B */
            n = add_compare(edges, n, 2, bit - 11, zero, period, action);
        else {
            fault("HRTIM: an output of %s follows event bit %u, which is not modelled", NAMES[timer], bit);
            return -1;
        }
    }
    return n;
}

static void sort(struct edge *edges, int n)
{
    for (int i = 1; i < n; i++)
        for (int j = i; j > 0; j--) {
            struct edge *a = &edges[j - 1], *b = &edges[j];
            /* at one instant the reset comes last: it has priority */
            if (a->at < b->at || (a->at == b->at && a->action >= b->action))
                break;
            struct edge swap = *a;
            *a = *b;
            *b = swap;
        }
}

/* Where the output goes up and how long it stays there, once it repeats. */
static int trace(unsigned timer, const struct edge *edges, int n, uint32_t period, struct hr_pulse *pulse)
{
    int level = 0, rises = 0;
    uint32_t on = 0, length = 0;
    for (int i = 0; i < 3 * n; i++) { /* the first rounds settle, the last is looked at */
        const struct edge *e = &edges[i % n];
        int before = level;
        level = e->action == TOGGLE ? !level : e->action == SET;
        if (level && !before) {
            on = e->at;
            rises += i >= 2 * n;
        } else if (before && !level) {
            length = e->at > on ? e->at - on : e->at + period - on;
        }
    }
    if (rises > 1) {
        fault("HRTIM: output 1 of %s rises %d times a period", NAMES[timer], rises);
        return -1;
    }
    *pulse = rises ? (struct hr_pulse){ on, length } : (struct hr_pulse){ 0, level ? period : 0 };
    return 0;
}

int hr_pulse_of(unsigned timer, struct hr_pulse *pulse, uint32_t *period, uint64_t *zero)
{
    struct edge edges[EDGES_MAX];
    if (hr_phase_of(timer, period, zero))
        return -1;
    if (*period < 3 * MIN_COMPARE) {
        fault("HRTIM: %s has a period of %u steps", NAMES[timer], *period);
        return -1;
    }
    const struct hr_shadow *s = &hr[timer].active;
    uint32_t both = s->set[0] & s->reset[0]; /* an event that sets and resets toggles */
    int n = add_sources(edges, 0, timer, s->set[0] & ~both, *zero, *period, SET);
    if (n >= 0)
        n = add_sources(edges, n, timer, s->reset[0] & ~both, *zero, *period, RESET);
    if (n >= 0)
        n = add_sources(edges, n, timer, both, *zero, *period, TOGGLE);
    if (n < 0)
        return -1;
    sort(edges, n);
    return trace(timer, edges, n, *period, pulse);
}

int64_t hr_lag(unsigned first, unsigned second, uint32_t *period)
{
    struct hr_pulse a, b;
    uint32_t period_b;
    uint64_t zero_a, zero_b;
    if (hr_pulse_of(first, &a, period, &zero_a) || hr_pulse_of(second, &b, &period_b, &zero_b))
        return -1;
    if (*period != period_b) {
        fault("HRTIM: the two legs have different periods, %u and %u steps", *period, period_b);
        return -1;
    }
    if ((!a.length && !b.length) || (a.length == *period && b.length == *period))
        return 0; /* both legs rest on one side: no voltage */
    int32_t uneven_a = (int32_t)(2 * a.length - *period), uneven_b = (int32_t)(2 * b.length - *period);
    if (uneven_a > 4 || uneven_a < -4 || uneven_b > 4 || uneven_b < -4) {
        fault("HRTIM: a leg is not high for half the period (%u and %u of %u steps): direct current through the coil", a.length,
              b.length, *period);
        return -1;
    }
    uint32_t lag = wrap(zero_a + a.on, zero_b + b.on, *period);
    return lag > *period / 2 ? *period - lag : lag;
}
