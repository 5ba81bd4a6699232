/* Time is TIM2: 32 bits at 72 MHz, free running.  Its first compare channel is the timer interrupt. */
#include "board/irq.h"
#include "board/timer.h"
#include "internal.h"
#include "sched.h"

enum { COMPARE_MARGIN = 24 };  /* ticks between writing the compare register and its match: the write must be first */

void timer_irq(void);
void timer_start(void);

void
timer_start(void)
{
    TIM_ARR(TIM2_BASE) = UINT32_MAX;
    TIM_SR(TIM2_BASE) = 0;
    TIM_DIER(TIM2_BASE) = TIM_DIER_CC1IE;
    TIM_CR1(TIM2_BASE) = TIM_CR1_CEN;
    irq_allow(IRQ_TIM2);
}

uint32_t
timer_read_time(void)
{
    return TIM_CNT(TIM2_BASE);
}

static void
wake_at(uint32_t clock)
{
    TIM_CCR1(TIM2_BASE) = clock;
    if (timer_is_before(clock, TIM_CNT(TIM2_BASE) + COMPARE_MARGIN))
        NVIC_ISPR(IRQ_TIM2 / 32) = BIT(IRQ_TIM2 % 32); /* it may have missed its match */
}

void
timer_kick(void)
{
    wake_at(sched_next_waketime());
}

void
timer_irq(void)
{
    TIM_SR(TIM2_BASE) = ~TIM_SR_CC1IF;
    wake_at(sched_timer_dispatch());
}

void
irq_wait(void)
{
    /* Asleep with interrupts masked, WFI still ends when one is pending: none can be missed. */
    __asm__ volatile("dsb\n wfi\n cpsie i\n isb\n cpsid i" ::: "memory");
}
