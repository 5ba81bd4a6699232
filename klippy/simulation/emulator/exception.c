/* Exception entry and return of a Cortex-M4, which unicorn lacks: ARMv7-M Architecture Reference Manual, B1.5.6 to B1.5.8. */
#include "core_state.h"

static void note_stack(uint32_t sp)
{
    if (counters.stack_limit && sp < counters.stack_limit)
        fault("the stack has run over its end: sp = 0x%08x, limit 0x%08x", sp, counters.stack_limit);
    if (sp < counters.stack_low)
        counters.stack_low = sp;
}

static const int FRAME_REGISTERS[FRAME_WORDS] = { UC_ARM_REG_R0,  UC_ARM_REG_R1, UC_ARM_REG_R2, UC_ARM_REG_R3,
                                                  UC_ARM_REG_R12, UC_ARM_REG_LR, UC_ARM_REG_PC, UC_ARM_REG_XPSR };

void enter_exception(int exception)
{
    uint32_t frame[FP_FRAME_WORDS] = { 0 }, sp = read_register(UC_ARM_REG_SP);
    uint32_t control = read_register(UC_ARM_REG_CONTROL);
    int words = control & 4u ? FP_FRAME_WORDS : FRAME_WORDS;
    if (control & 2u)
        fault("the process stack is not modelled");
    for (int i = 0; i < FRAME_WORDS; i++)
        frame[i] = read_register(FRAME_REGISTERS[i]);
    for (int i = 0; words == FP_FRAME_WORDS && i < 16; i++)
        frame[FRAME_WORDS + i] = read_register(UC_ARM_REG_S0 + i);
    frame[FRAME_WORDS + 16] = words == FP_FRAME_WORDS ? read_register(UC_ARM_REG_FPSCR) : 0;
    frame[6] = core.pc & ~1u;
    frame[7] = (frame[7] & ~0x3ffu) | (uint32_t)nvic_top_active() | (sp & 4u ? 0x200u : 0);
    uint32_t base = (sp - 4u * (uint32_t)words) & ~7u;
    if (memory_write(base, frame, 4u * (uint32_t)words))
        fault("an exception frame does not fit on the stack: sp = 0x%08x", sp);
    note_stack(base);
    uint32_t handler = 0;
    if (memory_read(nvic_vector_table() + 4u * (uint32_t)exception, &handler, 4) || !(handler & 1u))
        fault("the vector of exception %d is 0x%08x: no handler", exception, handler);
    write_register(UC_ARM_REG_SP, base);
    write_register(UC_ARM_REG_LR, 0xffffffe0u | (words == FP_FRAME_WORDS ? 0 : 0x10u) | (nvic_active_count() ? 1u : 9u));
    write_register(UC_ARM_REG_XPSR, 0x01000000u | (uint32_t)exception);
    if (words == FP_FRAME_WORDS)
        write_register(UC_ARM_REG_CONTROL, control & ~4u);
    core.pc = handler;
    uint64_t waited = now() - nvic_pended_at(exception);
    core.time += core.per_exception;
    nvic_enter(exception);
    core.nested[core.depth++] = (struct nested){ exception, 0, now() };
    counters.interrupts++;
    if (waited > counters.worst_latency_ticks)
        counters.worst_latency_ticks = (uint32_t)waited;
}

static void close_nested(void)
{
    const struct nested *last = &core.nested[--core.depth];
    uint32_t ticks = (uint32_t)(now() - last->since);
    int e = last->exception;
    counters.count[e]++;
    counters.spent[e] += last->instructions;
    if (last->instructions > counters.longest_instructions[e])
        counters.longest_instructions[e] = last->instructions;
    if (ticks > counters.longest_ticks[e])
        counters.longest_ticks[e] = ticks;
}

void return_from_exception(void)
{
    uint32_t magic = core.pc & 0x1eu; /* bit 4: no floating point frame; bits 3..0: 0001 handler, 1001 thread */
    uint32_t frame[FP_FRAME_WORDS], sp = read_register(UC_ARM_REG_SP);
    int words = magic & 0x10u ? FRAME_WORDS : FP_FRAME_WORDS, to_thread = (magic & 8u) != 0;
    if (!core.depth) {
        fault("a jump to 0x%08x, which returns from an exception, and none is active", core.pc);
        return;
    }
    if (magic & 4u || memory_read(sp, frame, 4u * (uint32_t)words)) {
        fault("a return from an exception with a bad stack: EXC_RETURN 0x%08x, sp 0x%08x", core.pc, sp);
        return;
    }
    int exception = nvic_top_active(), back_to = (int)(frame[7] & 0x1ffu);
    core.time += core.per_exception;
    close_nested();
    nvic_leave(exception);
    if (to_thread != (nvic_active_count() == 0) || back_to != nvic_top_active())
        fault("a return from exception %d to %s, but %d exceptions are active and the frame is of exception %d", exception,
              to_thread ? "thread mode" : "a handler", nvic_active_count(), back_to);
    for (int i = 0; i < 6; i++)
        write_register(FRAME_REGISTERS[i], frame[i]);
    for (int i = 0; words == FP_FRAME_WORDS && i < 16; i++)
        write_register(UC_ARM_REG_S0 + i, frame[FRAME_WORDS + i]);
    if (words == FP_FRAME_WORDS) {
        write_register(UC_ARM_REG_FPSCR, frame[FRAME_WORDS + 16]);
        write_register(UC_ARM_REG_CONTROL, read_register(UC_ARM_REG_CONTROL) | 4u);
    }
    write_register(UC_ARM_REG_SP, sp + 4u * (uint32_t)words + (frame[7] & 0x200u ? 4u : 0));
    write_register(UC_ARM_REG_XPSR, frame[7] & ~0x200u);
    write_register(UC_ARM_REG_FAULTMASK, 0);
    core.pc = frame[6] | 1u;
}
