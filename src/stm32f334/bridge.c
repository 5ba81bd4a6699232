/* The full bridge: HRTIM timer A is leg A, timer B leg B (README.md has the table of events, docs/reference/STM32F334.md the waveform).
 *
 *     counter   0         d          PER/2      d+PER/2    PER
 *     leg A     ‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾_______________________      set PER (= 0), reset CMP1
 *     leg B     __________‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾‾_____________      set CMP1 = d, reset CMP2 = d + PER/2 or PER
 *
 * Each leg's second output is the complement, with dead time.  All compare and set registers are preloaded and taken over
 * at the period's edge, where leg B is low in any case (it is also reset by PER): the new phase begins with a whole pulse.
 *
 * Three ways to stop.  Fault line, low supply, dead crystal: hardware, into the fault state, outputs inactive; an interrupt
 * then only reports.  bridge_pwm_off: ODISR.  Anything the processor trips over: stop_handler, ODISR.  All end with four
 * switches open.
 *
 * Refusing.  bridge_pwm_setup() shuts down with the reason if anything it set up does not read back, and
 * outputs are switched on only after the same look once more: clock tree, delay line, ADC, fault line, supply.
 */
#include "board/bridge_pwm.h"
#include "board/delay.h"
#include "board/irq.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT("BRIDGE_PHASE_MAX", 45000);

enum {
    STEPS_PER_TICK = 64,        /* 4.608 GHz / 72 MHz */
    PERIOD_TICKS_MIN = 300, PERIOD_TICKS_MAX = 1000, /* 240 to 72 kHz; the registers hold 1 to 1023 */
    LAG_MIN_STEPS = 192,        /* 6 periods of 144 MHz: compare values start at 3, and reset and set need 2 apart */
    SAMPLE_STEPS = 128,         /* ADC trigger after the edge: the smallest allowed multiple of a 72 MHz cycle */
    SPIN_LIMIT = 20000,         /* the delay line needs 14 us */
    PIN_FAULT = PIN_A + 12, FUNCTION_HRTIM = 13,
    FAULT_INACTIVE = 2,         /* OUTR.FAULTx: outputs inactive */
    FILTER_8 = 3,               /* FLTxF: 8 samples at 144 MHz, 56 ns */
};
#define LEG_A HRTIM_TIMER(0)
#define LEG_B HRTIM_TIMER(1)
#define OUTPUTS (HRTIM_OENR_TA1OEN | HRTIM_OENR_TA2OEN | HRTIM_OENR_TB1OEN | HRTIM_OENR_TB2OEN)
#define HELD (HRTIM_CR1_TAUDIS | HRTIM_CR1_TBUDIS)
#define FAULTS (HRTIM_ISR_FLT1 | HRTIM_ISR_SYSFLT)

/* Dead time: steps of 868 ps, or of 1736 ps above 443 ns (RM0364, DTPRSC), rounded up. */
enum {
    DEAD_COARSE = CONFIG_DEAD_TIME_NS > 443,
    DEAD_STEPS = (CONFIG_DEAD_TIME_NS * 1000 + (DEAD_COARSE ? 1735 : 867)) / (DEAD_COARSE ? 1736 : 868),
};
_Static_assert(DEAD_STEPS > 0 && DEAD_STEPS <= 511, "dead time out of range");

static struct {
    uint32_t period_steps;      /* 0: not set up; nothing below touches HRTIM then, its clock may be off */
    uint16_t sample_steps;      /* ADC trigger after the edge */
    uint8_t on;                 /* outputs enabled */
} bridge;

void bridge_fault_irq(void);
void nmi_handler(void);

void
bridge_init(void)
{
    bridge.period_steps = 0;
    bridge.on = 0;
}
DECL_INIT(bridge_init);

/****************************************************************
 * Is everything as it must be?
 ****************************************************************/

static uint32_t
control_word(void)
{
    return HRTIM_TIM_CR_CK_PSC(0) | HRTIM_TIM_CR_CONT | HRTIM_TIM_CR_TxREPU | HRTIM_TIM_CR_PREEN;
}

static uint32_t
dead_time_word(void)
{
    return HRTIM_TIM_DT_DTR(DEAD_STEPS) | HRTIM_TIM_DT_DTF(DEAD_STEPS) | HRTIM_TIM_DT_DTPRSC(DEAD_COARSE) |
           HRTIM_TIM_DT_DTRLK | HRTIM_TIM_DT_DTRSLK | HRTIM_TIM_DT_DTFLK | HRTIM_TIM_DT_DTFSLK;
}

static const uint32_t output_word =
    HRTIM_TIM_OUT_FAULT1(FAULT_INACTIVE) | HRTIM_TIM_OUT_FAULT2(FAULT_INACTIVE) | HRTIM_TIM_OUT_DTEN;
static const uint32_t leg_fault_word = HRTIM_TIM_FLT_FLT1EN | HRTIM_TIM_FLT_FLTLCK;
static const uint32_t fault_input_word = HRTIM_FLTINR1_FLT1E | HRTIM_FLTINR1_FLT1F(FILTER_8) |
                                         (CONFIG_FAULT_ACTIVE_HIGH ? HRTIM_FLTINR1_FLT1P : 0) | HRTIM_FLTINR1_FLT1LCK;

static uint8_t
leg_reads_back(uint32_t leg)
{
    return HRTIM_TIM_CR(leg) == control_word() && HRTIM_TIM_PER(leg) == bridge.period_steps && HRTIM_TIM_REP(leg) == 0 &&
           HRTIM_TIM_DT(leg) == dead_time_word() && HRTIM_TIM_OUT(leg) == output_word && HRTIM_TIM_FLT(leg) == leg_fault_word;
}

/* SHUTDOWN_NONE, or why the bridge must not be energised.  The first half needs no clock at HRTIM. */
static enum shutdown_reason
objection_outside(void)
{
    if (boot_findings() & BOOT_NO_CLOCK || !clock_verify() || !peripherals_verify())
        return SHUTDOWN_BRIDGE_CLOCK;
    if (boot_findings() & BOOT_BROWN_OUT)
        return SHUTDOWN_BRIDGE_BROWN_OUT;
    if (supply_is_low())
        return SHUTDOWN_BRIDGE_SUPPLY;
    return SHUTDOWN_NONE;
}

static enum shutdown_reason
objection_to_clock(void)
{
    if (!(RCC_CFGR3 & RCC_CFGR3_HRTIM1SW) || !(RCC_APB2ENR & RCC_APB2ENR_HRTIM1EN))
        return SHUTDOWN_BRIDGE_CLOCK;
    return SHUTDOWN_NONE;
}

static uint8_t
counts(uint32_t leg)
{
    uint32_t count = HRTIM_TIM_CNT(leg);
    delay_ticks(2);
    return HRTIM_TIM_CNT(leg) != count;
}

static enum shutdown_reason
objection_inside(void)
{
    if (!(HRTIM_ISR & HRTIM_ISR_DLLRDY))
        return SHUTDOWN_BRIDGE_DELAY_LINE;
    const uint32_t running = HRTIM_MASTER_MCR_TACEN | HRTIM_MASTER_MCR_TBCEN;
    if (!leg_reads_back(LEG_A) || !leg_reads_back(LEG_B) || (HRTIM_MASTER_MCR & running) != running ||
        HRTIM_TIM_CMP1(LEG_A) != bridge.period_steps / 2 || HRTIM_TIM_CMP4(LEG_A) != bridge.sample_steps ||
        HRTIM_ADC1R != HRTIM_ADC1R_AD1TAC4 || HRTIM_FLTINR1 != fault_input_word)
        return SHUTDOWN_BRIDGE_REGISTERS;
    if (!counts(LEG_A) || !counts(LEG_B))
        return SHUTDOWN_BRIDGE_CLOCK;
    HRTIM_ICR = HRTIM_ICR_FLT1C | HRTIM_ICR_SYSFLTC; /* a fault that is over has been reported; another comes again */
    if (HRTIM_ISR & FAULTS || pin_level(PIN_FAULT) == CONFIG_FAULT_ACTIVE_HIGH)
        return SHUTDOWN_BRIDGE_FAULT_AT_START;
    return SHUTDOWN_NONE;
}

static void
refuse(enum shutdown_reason reason)
{
    if (reason != SHUTDOWN_NONE)
        shutdown(reason);
}

/****************************************************************
 * Set-up (task context)
 ****************************************************************/

static void
start_clock(void)
{
    RCC_CFGR3 |= RCC_CFGR3_HRTIM1SW;
    RCC_APB2ENR |= RCC_APB2ENR_HRTIM1EN;
    refuse(objection_to_clock());
}

static void
calibrate_delay_line(void)
{
    HRTIM_DLLCR = HRTIM_DLLCR_CAL;
    for (unsigned spin = 0; !(HRTIM_ISR & HRTIM_ISR_DLLRDY); spin++)
        if (spin == SPIN_LIMIT)
            shutdown(SHUTDOWN_BRIDGE_DELAY_LINE);
    HRTIM_DLLCR = HRTIM_DLLCR_CALRTE(3) | HRTIM_DLLCR_CALEN; /* from now on every 14 us: temperature, supply */
}

static void
set_up_leg(uint32_t leg)
{
    HRTIM_TIM_CR(leg) = HRTIM_TIM_CR_CK_PSC(0) | HRTIM_TIM_CR_CONT; /* no preload yet: what follows is in force at once */
    HRTIM_TIM_PER(leg) = bridge.period_steps;
    HRTIM_TIM_REP(leg) = 0;
    HRTIM_TIM_CMP1(leg) = bridge.period_steps / 2;
    HRTIM_TIM_SET1(leg) = 0;
    HRTIM_TIM_RST1(leg) = HRTIM_TIM_RST1_PER | HRTIM_TIM_RST1_CMP1;
    HRTIM_TIM_DT(leg) = dead_time_word();
    HRTIM_TIM_OUT(leg) = output_word;
    HRTIM_TIM_FLT(leg) = leg_fault_word;
}

static void
set_up_fault_line(void)
{
    pin_set_pull(PIN_FAULT, CONFIG_FAULT_ACTIVE_HIGH ? -1 : 1);
    pin_set_function(PIN_FAULT, FUNCTION_HRTIM);
    HRTIM_FLTINR1 = fault_input_word & ~(HRTIM_FLTINR1_FLT1E | HRTIM_FLTINR1_FLT1LCK);
    HRTIM_FLTINR1 = fault_input_word & ~HRTIM_FLTINR1_FLT1LCK;
    HRTIM_FLTINR1 = fault_input_word;
    HRTIM_ICR = HRTIM_ICR_FLT1C | HRTIM_ICR_SYSFLTC;
}

struct bridge_pwm
bridge_pwm_setup(uint8_t id, uint32_t period_ticks)
{
    if (id)
        shutdown(SHUTDOWN_BRIDGE_ID);
    if (period_ticks < PERIOD_TICKS_MIN || period_ticks > PERIOD_TICKS_MAX)
        shutdown(SHUTDOWN_BRIDGE_PERIOD);
    refuse(objection_outside());
    start_clock();
    calibrate_delay_line();
    bridge.period_steps = period_ticks * STEPS_PER_TICK;
    set_up_leg(LEG_A);
    set_up_leg(LEG_B);
    HRTIM_TIM_RST1(LEG_B) = HRTIM_TIM_RST1_PER | HRTIM_TIM_RST1_CMP2;
    HRTIM_TIM_CMP2(LEG_B) = bridge.period_steps;
    bridge.sample_steps = SAMPLE_STEPS;
    HRTIM_TIM_CMP4(LEG_A) = SAMPLE_STEPS;
    HRTIM_ADC1R = HRTIM_ADC1R_AD1TAC4;
    HRTIM_TIM_CR(LEG_A) = control_word();
    HRTIM_TIM_CR(LEG_B) = control_word();
    set_up_fault_line();
    HRTIM_ODISR = OUTPUTS;
    for (uint32_t pin = PIN_A + 8; pin <= PIN_A + 11; pin++)
        pin_set_function(pin, FUNCTION_HRTIM);
    HRTIM_MASTER_MCR = HRTIM_MASTER_MCR_TACEN | HRTIM_MASTER_MCR_TBCEN; /* in step: one write starts both */
    refuse(objection_inside());
    HRTIM_IER = HRTIM_IER_FLT1IE | HRTIM_IER_SYSFLTIE;
    irq_allow(IRQ_HRTIM1_FLT);
    return (struct bridge_pwm){ id };
}

uint32_t
bridge_period_ticks(void)
{
    return bridge.period_steps / STEPS_PER_TICK;
}

/* The trigger's compare register is preloaded like the others: in force from the next edge on. */
void
bridge_move_sampling(uint16_t ticks)
{
    bridge.sample_steps = (uint16_t)(SAMPLE_STEPS + ticks * STEPS_PER_TICK);
    if (bridge.period_steps)
        HRTIM_TIM_CMP4(LEG_A) = bridge.sample_steps;
}

/* Ticks until the next period edge, rounded up. */
uint32_t
bridge_ticks_to_edge(void)
{
    return (bridge.period_steps - HRTIM_TIM_CNT(LEG_A) + STEPS_PER_TICK - 1) / STEPS_PER_TICK;
}

/* The clock of the next period edge.  The two counters are read one right after the other. */
uint32_t
bridge_next_edge(void)
{
    uint32_t count = HRTIM_TIM_CNT(LEG_A), now = timer_read_time();
    return now + (bridge.period_steps - count + STEPS_PER_TICK - 1) / STEPS_PER_TICK;
}

/****************************************************************
 * Running (any context)
 ****************************************************************/

static void
switch_on(void)
{
    refuse(objection_outside());
    refuse(objection_to_clock());
    refuse(objection_inside());
    refuse(sync_adc_objection());
    HRTIM_IER = HRTIM_IER_FLT1IE | HRTIM_IER_SYSFLTIE; /* a fault before has been reported */
    HRTIM_TIM_SET1(LEG_A) = HRTIM_TIM_SET1_PER;
    HRTIM_TIM_SET1(LEG_B) = HRTIM_TIM_SET1_CMP1;
    HRTIM_OENR = OUTPUTS;
    bridge.on = 1;
}

void
bridge_pwm_set_phase(struct bridge_pwm b, uint16_t phase)
{
    if (!bridge.period_steps)
        return;
    if (!phase) {
        bridge_pwm_off(b);
        return;
    }
    if (phase > BRIDGE_PHASE_MAX)
        phase = BRIDGE_PHASE_MAX;
    irqstatus_t flag = irq_save();
    uint32_t half = bridge.period_steps / 2, lag = (phase * half + BRIDGE_PHASE_MAX / 2) / BRIDGE_PHASE_MAX;
    if (lag < LAG_MIN_STEPS)
        lag = LAG_MIN_STEPS;
    HRTIM_CR1 = HELD; /* an edge between two of these writes must not take over one without the other */
    HRTIM_TIM_CMP1(LEG_B) = lag;
    HRTIM_TIM_CMP2(LEG_B) = lag + half;
    if (!bridge.on)
        switch_on();
    else
        refuse(sync_adc_objection());
    HRTIM_CR1 = 0;
    irq_restore(flag);
}

void
bridge_pwm_off(struct bridge_pwm b)
{
    (void)b;
    if (!bridge.period_steps)
        return;
    HRTIM_ODISR = OUTPUTS;
    bridge.on = 0;
    HRTIM_TIM_SET1(LEG_A) = 0;
    HRTIM_TIM_SET1(LEG_B) = 0;
    HRTIM_CR1 = 0;
}

/****************************************************************
 * When hardware has stopped it (irq context)
 ****************************************************************/

/* For handlers that do not return, from whatever state: looks at no memory. */
void
bridge_stop(void)
{
    if (RCC_APB2ENR & RCC_APB2ENR_HRTIM1EN)
        HRTIM_ODISR = OUTPUTS;
}

static void
report_fault(void *unused)
{
    (void)unused;
    uint32_t flags = HRTIM_ISR;
    bridge_pwm_off((struct bridge_pwm){ 0 });
    HRTIM_ICR = HRTIM_ICR_FLT1C | HRTIM_ICR_SYSFLTC;
    HRTIM_IER = 0; /* one report; a line that stays active would come again for ever.  Outputs stay guarded by hardware */
    try_shutdown(flags & HRTIM_ISR_SYSFLT ? SHUTDOWN_BRIDGE_SYSTEM_FAULT : SHUTDOWN_BRIDGE_FAULT);
}

void
bridge_fault_irq(void)
{
    sched_guarded(report_fault, 0);
}

/* Only the clock security raises it: the crystal has stopped, the chip runs on at 8 MHz from its own oscillator, time is lost
 * and the console's rate wrong.  Everything off; the watchdog resets the chip, which then comes up at 64 MHz and reports. */
void
nmi_handler(void)
{
    RCC_CIR |= RCC_CIR_CSSC;
    bridge_stop();
    for (;;)
        ;
}
