/* Board contract: interrupts.
 *
 * port_types.h defines `irqstatus_t` and may define these as static inline functions, in which case it also defines
 * PORT_INLINE_IRQ.  Nesting is done with save/restore; disable/enable are for main loops and shutdown.
 *
 *   irq_wait   called with interrupts disabled and nothing to do: sleep until the next interrupt, let it run, return
 *              with interrupts disabled.  Must not miss an interrupt that came after irq_disable().
 */
#ifndef BOARD_IRQ_H
#define BOARD_IRQ_H

#include "port_types.h"

#ifndef PORT_INLINE_IRQ
void irq_disable(void);
void irq_enable(void);
irqstatus_t irq_save(void);
void irq_restore(irqstatus_t flag);
#endif
void irq_wait(void);

#endif
