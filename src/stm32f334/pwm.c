/* Hardware PWM: TIM3, TIM15, TIM16, TIM17 count 255 steps of a prescaled 72 MHz; a compare value of 0 is off, of 255 is on.
 *
 * The channels of one timer share its period; a second one with another period is refused.
 */
#include "board/pwm.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT("PWM_MAX", PORT_PWM_MAX);

enum { TIMERS = 4, MODE_PWM1 = 6, PRESCALER_MAX = 65536 };
static const uint32_t bases[TIMERS] = { TIM3_BASE, TIM15_BASE, TIM16_BASE, TIM17_BASE };

/* DS9994.  Timer: index into bases; channel 1 to 4. */
static const struct output { uint8_t pin, timer, channel, function; } outputs[] = {
    { PIN_A + 6, 0, 1, 2 }, { PIN_A + 7, 0, 2, 2 }, { PIN_B + 0, 0, 3, 2 }, { PIN_B + 1, 0, 4, 2 },
    { PIN_B + 4, 0, 1, 2 }, { PIN_B + 5, 0, 2, 2 }, { PIN_C + 6, 0, 1, 2 }, { PIN_C + 7, 0, 2, 2 },
    { PIN_C + 8, 0, 3, 2 }, { PIN_C + 9, 0, 4, 2 }, { PIN_B + 14, 1, 1, 1 }, { PIN_B + 15, 1, 2, 1 },
    { PIN_B + 8, 2, 1, 1 }, { PIN_B + 9, 3, 1, 1 },
};

static uint32_t prescaler_of[TIMERS];  /* 0: the timer is not in use */

void
pwm_init(void)
{
    for (unsigned i = 0; i < TIMERS; i++)
        prescaler_of[i] = 0;
}
DECL_INIT(pwm_init);

static void
start_timer(uint8_t timer, uint32_t prescaler)
{
    uint32_t base = bases[timer];
    if (base == TIM3_BASE)
        RCC_APB1ENR |= RCC_APB1ENR_TIM3EN;
    else
        RCC_APB2ENR |= base == TIM15_BASE ? RCC_APB2ENR_TIM15EN : base == TIM16_BASE ? RCC_APB2ENR_TIM16EN
                                                                                     : RCC_APB2ENR_TIM17EN;
    (void)RCC_APB2ENR;
    TIM_PSC(base) = prescaler - 1;
    TIM_ARR(base) = PORT_PWM_MAX - 1;
    TIM_EGR(base) = TIM_EGR_UG; /* takes the prescaler over */
    TIM_CR1(base) = TIM_CR1_ARPE | TIM_CR1_CEN;
    if (base != TIM3_BASE)
        TIM_BDTR(base) = TIM_BDTR_MOE;
    prescaler_of[timer] = prescaler;
}

static void
start_channel(const struct output *o)
{
    uint32_t base = bases[o->timer];
    volatile uint32_t *mode = o->channel < 3 ? &TIM_CCMR1(base) : &TIM_CCMR2(base);
    *mode |= o->channel & 1 ? TIM_CCMR1_OC1M(MODE_PWM1) | TIM_CCMR1_OC1PE : TIM_CCMR1_OC2M(MODE_PWM1) | TIM_CCMR1_OC2PE;
    TIM_CCER(base) |= TIM_CCER_CC1E << 4 * (o->channel - 1);
    pin_set_function(o->pin, o->function);
}

struct pwm_out
pwm_setup(uint32_t pin, uint32_t cycle_ticks, uint32_t value)
{
    const struct output *o = outputs, *end = outputs + sizeof(outputs) / sizeof(outputs[0]);
    while (o < end && o->pin != pin)
        o++;
    if (o == end)
        shutdown(SHUTDOWN_NOT_PWM_PIN);
    uint32_t prescaler = (cycle_ticks + PORT_PWM_MAX / 2) / PORT_PWM_MAX;
    prescaler = !prescaler ? 1 : prescaler > PRESCALER_MAX ? PRESCALER_MAX : prescaler;
    if (prescaler_of[o->timer] && prescaler_of[o->timer] != prescaler)
        shutdown(SHUTDOWN_PWM_CYCLE);
    if (!prescaler_of[o->timer])
        start_timer(o->timer, prescaler);
    struct pwm_out p = { &TIM_CCR1(bases[o->timer]) + o->channel - 1 };
    pwm_write(p, value);
    start_channel(o);
    TIM_EGR(bases[o->timer]) = TIM_EGR_UG; /* the value is in force at once */
    return p;
}

/* An object whose set-up ended in a shutdown has no output yet, and its DECL_SHUTDOWN function writes all the same. */
void
pwm_write(struct pwm_out p, uint32_t value)
{
    if (!p.compare)
        return;
    *p.compare = value > PORT_PWM_MAX ? PORT_PWM_MAX : value;
}
