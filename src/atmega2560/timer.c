/* The clock: Timer5, free running at the processor's 16 MHz, extended from 16 bits to 32 by its overflow.
 *
 *     overflows  |0     |1     |2     |3     |4        one every 4.096 ms
 *     TCNT5      /|/|/|/|/|/|/|/|/|/|/|/|/|/|/|
 *                                      ▲ OCR5A: enabled only while the next timer is less than HORIZON ahead;
 *                                        farther ones are looked at again at each overflow
 *
 * The compare interrupt runs the timers with the other interrupts (bytes, overflow) allowed and itself masked: a received
 * byte must be fetched within 80 us, and several steppers due at once can take longer.  Those interrupts touch nothing that
 * timers do.
 */
#include "board/irq.h"
#include "board/timer.h"
#include "internal.h"
#include "sched.h"

enum {
    HORIZON = 0xff00, /* less than a round, which is when the overflow looks again */
    /* Closer than this the compare register may be passed while it is being written; Origin: the code between reading the
     * clock and the end of the write is some 70 cycles. */
    TOO_CLOSE = 128,
    /* If timers leave the tasks nothing, they get 50 us after 8 ms at most; a ring of received bytes is full after 10. */
    PAUSE = 800,
    PAUSE_OVERFLOWS = 2,
};

static volatile uint16_t overflows;
static uint8_t tasks_ran;   /* low bits of the overflows when tasks have last had so long */
static uint8_t dispatching;

void
timer_start(void)
{
    TCCR5A = 0;
    TCCR5B = 1 << CS50;
    TIMSK5 = 1 << TOIE5;
}

/* Interrupts disabled, for less than 2 ms.  An overflow not yet counted shows in TOV5; it belongs to this reading if the
 * counter is low. */
static inline uint32_t
read_clock(void)
{
    union {  /* the compiler shifts where it need only put the halves side by side */
        uint16_t half[2];
        uint32_t clock;
    } now = { .half = { TCNT5, overflows } };
    if (TIFR5 & 1 << TOV5 && now.half[0] < 0x8000)
        now.half[1]++;
    return now.clock;
}

__attribute__((always_inline)) inline uint32_t
timer_read_time(void)
{
    irqstatus_t flag = irq_save();
    uint32_t clock = read_clock();
    irq_restore(flag);
    return clock;
}

/* Interrupts disabled.  Let the compare interrupt come at `wake`, or look again at the overflow; 0 if it is too close. */
static uint8_t
set_alarm(uint32_t wake, uint32_t now)
{
    const int32_t ahead = (int32_t)(wake - now);
    if (ahead < TOO_CLOSE)
        return 0;
    TIMSK5 = 1 << TOIE5;
    if (ahead >= HORIZON)
        return 1;
    OCR5A = (uint16_t)wake;
    TIFR5 = 1 << OCF5A;
    TIMSK5 = 1 << TOIE5 | 1 << OCIE5A;
    return 1;
}

/* The list may change while its timers run: the loop in the interrupt looks at it again anyway. */
void
timer_kick(void)
{
    const uint32_t now = read_clock();
    if (!dispatching && !set_alarm(sched_next_waketime(), now))
        set_alarm(now + 2 * TOO_CLOSE, now);
}

static __attribute__((noinline)) void
run_timers(void)
{
    TIMSK5 = 1 << TOIE5;
    dispatching = 1;
    uint32_t next, now;
    do {
        irq_enable();
        next = sched_timer_dispatch();
        irq_disable();
        now = read_clock();
        if (!timer_is_before(next, now + PAUSE)) {
            tasks_ran = (uint8_t)overflows;
        } else if ((uint8_t)((uint8_t)overflows - tasks_ran) >= PAUSE_OVERFLOWS) {
            tasks_ran = (uint8_t)overflows;
            next = now + PAUSE;
        }
    } while (!set_alarm(next, now));
    dispatching = 0;
}

/* A function of its own: the handler saves what such may change, and that what else it needs. */
ISR(TIMER5_COMPA_vect)
{
    run_timers();
}

/* With the alarm set there is nothing to look at: it was less than a round away. */
ISR(TIMER5_OVF_vect)
{
    overflows++;
    if (!(TIMSK5 & 1 << OCIE5A))
        timer_kick();
}
