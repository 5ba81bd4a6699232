/* HRTIM's outputs: what the bridge does, switching on and off, fault inputs (RM0364, 21.3.6 to 21.3.15). */
#include "chip.h"
#include "hrtim.h"

enum { PHASE_MAX = 45000, FAULTS = 5, SYSFLT = 1u << 5 };

void hr_fault_irq(void)
{
    nvic_line(IRQ_HRTIM_FLT, (h.isr & h.ier & 0x3fu) != 0);
}

/* ---- what the bridge does --------------------------------------------------------------------------- */

static void send(uint16_t phase, int64_t lag)
{
    if (h.sent && phase == h.phase)
        return;
    adc_before_change();
    h.phase = phase;
    h.sent = 1;
    counters.phase_writes++;
    record(RECORD_LAGS, now(), (uint32_t)lag);
    board.bridge_set(board.ctx, phase, now());
}

int hr_leg_on(unsigned timer)
{
    return (h.enabled >> 2 * (timer - 1) & 3u) == 3u;
}

static void check_leg(unsigned timer)
{
    const struct hr_timer *t = &hr[timer];
    if (!t->running)
        fault("HRTIM: outputs of timer %c are on while its counter stands", 'A' + timer - 1);
    if (!(t->outr & 1u << 8))
        fault("HRTIM: the two switches of leg %c have no dead time (OUTR.DTEN is 0): shoot-through", 'A' + timer - 1);
    else if (!(t->active.dead_time & 0x1ffu) || !(t->active.dead_time >> 16 & 0x1ffu))
        fault("HRTIM: the dead time of leg %c is zero (DTR = 0x%08x)", 'A' + timer - 1, t->active.dead_time);
    if (t->outr & (1u << 1 | 1u << 17 | 1u << 6 | 1u << 22))
        fault("HRTIM: inverted or chopped outputs are not modelled (OUTR = 0x%x)", t->outr);
    if (t->outr & (1u << 3 | 1u << 19))
        fault("HRTIM: the idle level of leg %c is active (OUTR = 0x%x): switched off it conducts", 'A' + timer - 1, t->outr);
}

void hr_evaluate(void)
{
    unsigned legs[2], n = 0;
    for (unsigned t = 1; t < HR_TIMERS; t++)
        if (hr_leg_on(t) && n < 2)
            legs[n++] = t;
    if (n < 2) {
        send(0, 0); /* one leg alone drives no current */
        return;
    }
    check_leg(legs[0]);
    check_leg(legs[1]);
    uint32_t period;
    int64_t lag = hr_lag(legs[0], legs[1], &period);
    if (lag >= 0)
        send((uint16_t)((lag * 2 * PHASE_MAX + period / 2) / period), lag);
}

/* ---- faults ------------------------------------------------------------------------------------------------ */

/* The line of the driver's fault output: pulled up, low when it objects. Only a pin that is set up as a fault input sees it
 * (DS9994): FLT1 PA12, FLT2 PA15, FLT3 PB10, FLT4 PB11 in alternate function 13, FLT5 PC7 in function 3. */
static const struct { uint8_t pin, function; } FAULT_PINS[FAULTS] = { { 12, 13 }, { 15, 13 }, { 26, 13 }, { 27, 13 }, { 39, 3 } };

int hrtim_is_fault_input(unsigned pin)
{
    for (unsigned i = 0; i < FAULTS; i++)
        if (FAULT_PINS[i].pin == pin && gpio_function(pin) == FAULT_PINS[i].function)
            return 1;
    return 0;
}

static int input_active(unsigned i)
{
    uint32_t reg = i < 4 ? h.fltinr[0] >> 8 * i : h.fltinr[1];
    if (!(reg & 1u) || reg & 4u || !hrtim_is_fault_input(FAULT_PINS[i].pin)) /* bit 2: from a comparator */
        return 0;
    int level = !mutation.fault_line;
    return reg & 2u ? level : !level;
}

static void faults_off(uint32_t active, int system)
{
    uint32_t off = 0;
    for (unsigned t = 1; t < HR_TIMERS; t++) {
        if (!system && !(hr[t].fltr & active & 0x1fu))
            continue;
        for (unsigned o = 0; o < 2; o++)
            if (hr[t].outr >> (4 + 16 * o) & 3u) /* FAULTx: 0 means that a fault does nothing to this output */
                off |= 1u << (2 * (t - 1) + o);
    }
    h.faulted |= off & h.enabled;
    h.enabled &= ~off;
    if (off)
        hr_evaluate();
}

void hrtim_system_fault(void)
{
    h.isr |= SYSFLT;
    hr_fault_irq();
    faults_off(0, 1);
}

void hrtim_fault_line(void)
{
    uint32_t active = 0;
    for (unsigned i = 0; i < FAULTS; i++)
        active |= (uint32_t)input_active(i) << i;
    int system = mutation.brown_out && pwr_system_fault();
    h.isr |= active | (system ? SYSFLT : 0);
    hr_fault_irq();
    faults_off(active, system);
}

/* ---- outputs ------------------------------------------------------------------------------------------------- */

static void check_pins(uint32_t outputs)
{
    static const struct { uint8_t pin, function; } PINS[HR_OUTPUTS] = {
        { 8, 13 }, { 9, 13 }, { 10, 13 }, { 11, 13 }, { 28, 13 }, { 29, 13 }, { 30, 13 }, { 31, 13 }, { 40, 3 }, { 41, 3 },
    };
    for (unsigned i = 0; i < HR_OUTPUTS; i++)
        if (outputs >> i & 1u && gpio_function(PINS[i].pin) != PINS[i].function)
            fault("HRTIM output %c%u is on, and its pin P%c%u is not in alternate function %u", 'A' + i / 2, i % 2 + 1,
                  'A' + PINS[i].pin / 16, PINS[i].pin % 16u, PINS[i].function);
}

void hr_outputs_on(uint32_t value)
{
    if (!(value & 0x3ffu))
        return;
    if (!hr_dll_ready())
        fault("HRTIM: outputs are switched on before the delay line is calibrated (DLLRDY is 0)");
    check_pins(value);
    h.enabled |= value & 0x3ffu;
    h.faulted &= ~value;
    hrtim_fault_line(); /* an active fault takes them off again at once */
    hr_evaluate();
}

void hr_outputs_off(uint32_t value)
{
    h.enabled &= ~value;
    h.faulted &= ~value;
    hr_evaluate();
}
