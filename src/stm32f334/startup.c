/* From reset to main(): the vector table, memory, and what happens when the processor objects. */
#include <stddef.h>
#include <stdint.h>

#include "internal.h"
#include "sched.h"

/* Of link.ld: only their addresses mean something. */
extern char data_start[], data_end[], data_image[], bss_start[], bss_end[], stack_top[];

void reset_handler(void);
void timer_irq(void);
void console_irq(void);
void console_sent_irq(void);
void samples_irq(void);
void adc_irq(void);
void bridge_fault_irq(void);
void nmi_handler(void);
void bridge_stop(void);

/* Memory is copied and cleared word by word. */
void
reset_handler(void)
{
    uintptr_t from = (uintptr_t)data_image;
    for (uintptr_t to = (uintptr_t)data_start; to < (uintptr_t)data_end; to += 4, from += 4)
        R(to, 0) = R(from, 0);
    for (uintptr_t to = (uintptr_t)bss_start; to < (uintptr_t)bss_end; to += 4)
        R(to, 0) = 0;
    __asm__ volatile("cpsid i" ::: "memory");
    extern int main(void);
    main();
}

/* Hard fault and every unexpected interrupt.  The bridge goes off at once; the other outputs when the watchdog, which
 * is no longer fed, has reset the chip. */
static void
stop_handler(void)
{
    __asm__ volatile("cpsid i" ::: "memory");
    bridge_stop();
    for (;;)
        ;
}

/* The small C library's goes byte by byte; this processor loads and stores words at any address. */
__attribute__((used, optimize("no-tree-loop-distribute-patterns"))) void *
memcpy(void *restrict to, const void *restrict from, size_t size)
{
    uint8_t *out = to;
    const uint8_t *in = from;
    for (; size >= 16; size -= 16, out += 16, in += 16) {
        struct unaligned *o = (struct unaligned *)out;
        const struct unaligned *i = (const struct unaligned *)in;
        o[0] = i[0];
        o[1] = i[1];
        o[2] = i[2];
        o[3] = i[3];
    }
    for (; size >= 4; size -= 4, out += 4, in += 4)
        *(struct unaligned *)out = *(const struct unaligned *)in;
    while (size--)
        *out++ = *in++;
    return to;
}

typedef void (*vector)(void);

/* RM0364 */
#define IRQ(n) (16 + (n))
__attribute__((section(".vectors"), used)) static const vector vectors[IRQ(IRQ_COUNT)] = {
    [0] = (vector)stack_top,
    [1] = reset_handler,
    [2] = nmi_handler,
    [3 ... 6] = stop_handler,
    [11 ... 12] = stop_handler,
    [14 ... 15] = stop_handler,
    [IRQ(0) ... IRQ(10)] = stop_handler,
    [IRQ(IRQ_DMA1_CHANNEL1)] = samples_irq,
    [IRQ(12) ... IRQ(16)] = stop_handler,
    [IRQ(IRQ_DMA1_CHANNEL7)] = console_sent_irq,
    [IRQ(IRQ_ADC1_2)] = adc_irq,
    [IRQ(19) ... IRQ(27)] = stop_handler,
    [IRQ(IRQ_TIM2)] = timer_irq,
    [IRQ(29) ... IRQ(37)] = stop_handler,
    [IRQ(IRQ_USART2)] = console_irq,
    [IRQ(39) ... IRQ(72)] = stop_handler,
    [IRQ(IRQ_HRTIM1_FLT)] = bridge_fault_irq,
    [IRQ(74) ... IRQ(IRQ_COUNT - 1)] = stop_handler,
};
