/* Parts of the HRTIM model (RM0364 chapter 21): registers and time in hrtim.c, the shape of the outputs in hrtim_wave.c. */
#ifndef EMULATOR_HRTIM_H
#define EMULATOR_HRTIM_H

#include "../core.h"

enum { HR_MASTER, HR_TIMERS = 6, HR_OUTPUTS = 10 };

/* The registers that have a preload copy (RM0364, 21.3.10). */
struct hr_shadow {
    uint32_t per, rep, cmp[4], dead_time, set[2], reset[2], counter_reset;
};

struct hr_timer {
    struct hr_shadow pre, active;
    uint32_t cr, isr, dier, outr, fltr;
    int running;
    uint64_t zero; /* a clock at which the counter was 0, in steps of the high resolution clock */
};

/* One output over one period: on from `on` for `length` steps, counted from timer A's (or the first leg's) zero. */
struct hr_pulse { uint32_t on, length; };

extern struct hr_timer hr[HR_TIMERS];

struct hr_common {
    uint32_t cr1, isr, ier, adc[4], dllcr, fltinr[2];
    uint32_t enabled, faulted; /* outputs, a bit each: in RUN state, in FAULT state */
    uint64_t dll_at;
    struct event update;
    uint16_t phase;            /* last sent to the world */
    int sent;
};
extern struct hr_common h;

/* hrtim_outputs.c */
int hr_leg_on(unsigned timer);
void hr_evaluate(void);             /* what the bridge does now goes to the world */
void hr_outputs_on(uint32_t value);
void hr_outputs_off(uint32_t value);
int hr_dll_ready(void);
void hr_fault_irq(void);

/* Period of the timer and where its counter is zero against `reference`'s, both in steps. -1: it has none that is
 * constant (a fault has been raised). */
int hr_phase_of(unsigned timer, uint32_t *period, uint64_t *zero);
/* The pulse that SETx1 and RSTx1 of a timer give, dead time left out; length 0 or the period: it does not switch. 0 or -1
 * (fault raised). */
int hr_pulse_of(unsigned timer, struct hr_pulse *pulse, uint32_t *period, uint64_t *zero);
/* How far the second leg lags the first, in steps, at most half a period; period in *period. -1: fault raised. */
int64_t hr_lag(unsigned first, unsigned second, uint32_t *period);

#endif
