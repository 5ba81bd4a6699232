/* The processor: unicorn with what it lacks around it (time, exceptions, sleep), and the interface of sim_mcu.h.
 *
 *     sim_mcu_advance ──► run until the clock asked for:
 *         asleep:  jump to the next event
 *         awake:   uc_emu_start ──► at each basic block: time += instructions * cycles; events due are run;
 *                                   an exception to take, or the end of the stretch, stops unicorn before the block
 *                  exception:  frame on the stack, LR = EXC_RETURN, PC from the vector table
 *                  return:     the magic address is a mapped page of its own; reaching it pops the frame
 *
 * Time moves only at the beginning of a block, by the whole block: a peripheral sees accesses of one block at one clock,
 * at most some tens of instructions late.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unicorn/unicorn.h>

#include "core.h"

#define RETURN_PAGE 0xfffff000u
#define RETURN_LOWEST 0xffffff00u

enum { FRACTION_BITS = 8, FRAME_WORDS = 8, FP_FRAME_WORDS = 26, REGIONS_MAX = 8, PAINT = 0xa5 };

struct block {
    uint16_t size;
    uint16_t instructions;
};

struct nested {
    int exception;
    uint32_t instructions;
    uint64_t since;
};

struct sim_board board;
struct emulator_counters counters;

static struct {
    uc_engine *uc;
    int loaded, powered, halted, asleep, faulted, reset_asked;
    uint32_t reset_cause;
    char fault_text[512];
    uint64_t time, per_instruction, per_exception; /* ticks << FRACTION_BITS */
    uint64_t until;                /* of the stretch under way, ticks << FRACTION_BITS */
    uint64_t check_at;             /* the earlier of until and the next event, same unit */
    struct event *events;
    uint32_t pc;                   /* where to go on, bit 0 set */
    uint32_t block;                /* under way */
    int wants_stop;
    struct nested nested[EMULATOR_VECTORS];
    int depth;
    uint8_t *memory[REGIONS_MAX];
    struct block *blocks[REGIONS_MAX];
    uint64_t *spent[REGIONS_MAX];
} core;

/* ---- time and events -------------------------------------------------------------------------- */

uint64_t now(void)
{
    return core.time >> FRACTION_BITS;
}

void core_set_cpu_hz(uint32_t hz)
{
    double ticks = (double)CORE_TICK_HZ / hz * (1 << FRACTION_BITS);
    core.per_instruction = (uint64_t)(ticks * CORE_CYCLES_PER_INSTRUCTION + 0.5);
    core.per_exception = (uint64_t)(ticks * CORE_EXCEPTION_CYCLES + 0.5);
}

static uint64_t next_due(void)
{
    uint64_t due = NEVER;
    for (const struct event *e = core.events; e; e = e->next)
        due = e->due < due ? e->due : due;
    return due;
}

static void set_check(void)
{
    uint64_t due = next_due();
    core.check_at = due >= core.until >> FRACTION_BITS ? core.until : due << FRACTION_BITS;
}

void event_at(struct event *e, uint64_t due)
{
    if (!e->known) {
        e->known = 1;
        e->next = core.events;
        core.events = e;
    }
    e->due = due;
    set_check();
}

/* Run what is due, the earliest first. */
static void run_events(void)
{
    for (;;) {
        struct event *first = NULL;
        for (struct event *e = core.events; e; e = e->next)
            if (e->due <= now() && (!first || e->due < first->due))
                first = e;
        if (!first)
            return;
        first->due = NEVER;
        first->run(first->arg);
        set_check();
    }
}

/* ---- objections ------------------------------------------------------------------------------- */

uint32_t core_where(void)
{
    return core.block;
}

void fault(const char *format, ...)
{
    if (core.faulted)
        return;
    char text[384];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    snprintf(core.fault_text, sizeof core.fault_text, "%s (in %s at 0x%08x, %.6f s after power-on)", text,
             symbol_at(core.block), core.block, (double)counters.ticks / CORE_TICK_HZ);
    core.faulted = 1;
    core.wants_stop = 1;
}

void core_halt(const char *why)
{
    snprintf(core.fault_text, sizeof core.fault_text, "%s", why);
    core.halted = 1;
    core.wants_stop = 1;
}

void core_reset(uint32_t cause)
{
    core.reset_asked = 1;
    core.reset_cause = cause;
    core.wants_stop = 1;
    counters.resets++;
}

/* ---- memory ------------------------------------------------------------------------------------ */

static int region_of(uint32_t address, uint32_t size)
{
    for (int i = 0; chip_regions[i].size; i++)
        if (address >= chip_regions[i].base && address - chip_regions[i].base <= chip_regions[i].size - size
            && size <= chip_regions[i].size)
            return i;
    return -1;
}

uint8_t *core_memory(uint32_t address)
{
    int i = region_of(address, 1);
    return i < 0 ? NULL : core.memory[i] + (address - chip_regions[i].base);
}

int memory_read(uint32_t address, void *data, uint32_t size)
{
    int i = region_of(address, size);
    if (i < 0)
        return -1;
    memcpy(data, core.memory[i] + (address - chip_regions[i].base), size);
    return 0;
}

int memory_write(uint32_t address, const void *data, uint32_t size)
{
    int i = region_of(address, size);
    if (i < 0 || !chip_regions[i].writable)
        return -1;
    memcpy(core.memory[i] + (address - chip_regions[i].base), data, size);
    return 0;
}

static uint64_t on_periph_read(uc_engine *uc, uint64_t offset, unsigned size, void *base)
{
    (void)uc;
    return core.faulted ? 0 : chip_read((uint32_t)(uintptr_t)base + (uint32_t)offset, size);
}

static void on_periph_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *base)
{
    (void)uc;
    if (!core.faulted)
        chip_write((uint32_t)(uintptr_t)base + (uint32_t)offset, (uint32_t)value, size);
}

/* The private peripheral bus takes bytes and halfwords in the priority registers; all else is words. */
static uint64_t on_ppb_read(uc_engine *uc, uint64_t offset, unsigned size, void *base)
{
    (void)uc;
    uint32_t address = (uint32_t)(uintptr_t)base + (uint32_t)offset;
    uint32_t value = core.faulted ? 0 : ppb_read(address & ~3u);
    value >>= 8 * (address & 3u);
    return size == 4 ? value : value & ((1u << 8 * size) - 1u);
}

static void on_ppb_write(uc_engine *uc, uint64_t offset, unsigned size, uint64_t value, void *base)
{
    (void)uc;
    uint32_t address = (uint32_t)(uintptr_t)base + (uint32_t)offset;
    if (core.faulted)
        return;
    if (size == 4) {
        ppb_write(address, (uint32_t)value);
        return;
    }
    uint32_t shift = 8 * (address & 3u), mask = ((1u << 8 * size) - 1u) << shift;
    ppb_write(address & ~3u, (ppb_read(address & ~3u) & ~mask) | ((uint32_t)value << shift & mask));
}

static bool on_bad_access(uc_engine *uc, uc_mem_type type, uint64_t address, int size, int64_t value, void *user)
{
    (void)uc;
    (void)user;
    const char *what = type == UC_MEM_WRITE_UNMAPPED || type == UC_MEM_WRITE_PROT ? "a write to"
                       : type == UC_MEM_FETCH_UNMAPPED || type == UC_MEM_FETCH_PROT ? "code fetched from"
                                                                                    : "a read at";
    fault("%s 0x%08x (%d bytes, value 0x%x): nothing is there, or it may not be used so", what, (uint32_t)address, size,
          (uint32_t)value);
    return false;
}

/* ---- counting ----------------------------------------------------------------------------------- */

static uint16_t count_instructions(const uint8_t *code, uint32_t size)
{
    uint16_t count = 0;
    for (uint32_t i = 0; i + 1 < size; count++) {
        uint32_t top = code[i + 1] >> 3; /* 0b11101, 0b11110, 0b11111: 32-bit instruction */
        i += top >= 0x1d ? 4 : 2;
    }
    return count;
}

static uint32_t instructions_of(uint32_t address, uint32_t size, uint64_t **spent)
{
    int i = region_of(address, 2);
    if (i < 0)
        return 1;
    uint32_t offset = address - chip_regions[i].base;
    struct block *b = &core.blocks[i][offset >> 1];
    if (b->size != size) {
        b->size = (uint16_t)size;
        b->instructions = count_instructions(core.memory[i] + offset, size);
    }
    *spent = &core.spent[i][offset >> 1];
    return b->instructions;
}

static uint32_t read_register(int reg)
{
    uint32_t value = 0;
    uc_reg_read(core.uc, reg, &value);
    return value;
}

static void write_register(int reg, uint32_t value)
{
    uc_reg_write(core.uc, reg, &value);
}

static int exception_to_take(void)
{
    if (!nvic_any_pending())
        return 0;
    return nvic_next(read_register(UC_ARM_REG_PRIMASK) & 1u, read_register(UC_ARM_REG_BASEPRI),
                     read_register(UC_ARM_REG_FAULTMASK) & 1u);
}

static void on_block(uc_engine *uc, uint64_t address, uint32_t size, void *user)
{
    (void)user;
    core.block = (uint32_t)address;
    if (core.time >= core.check_at)
        run_events();
    if (address >= RETURN_LOWEST || core.wants_stop || core.time >= core.until || exception_to_take()) {
        core.pc = (uint32_t)address | 1u;
        core.wants_stop = 1;
        uc_emu_stop(uc);
        return;
    }
    uint64_t unused, *spent = &unused;
    uint32_t count = instructions_of((uint32_t)address, size, &spent);
    *spent += count;
    counters.instructions += count;
    core.time += count * core.per_instruction;
    if (core.depth) {
        counters.interrupt_instructions += count;
        core.nested[core.depth - 1].instructions += count;
    }
}

static void on_interrupt(uc_engine *uc, uint32_t number, void *user)
{
    (void)user;
    /* A jump to EXC_RETURN shows as one of these: unicorn knows whether it is in a handler only after it has looked again. */
    enum { PREFETCH_ABORT = 3, EXCEPTION_EXIT = 8 };
    if ((number != PREFETCH_ABORT && number != EXCEPTION_EXIT) || read_register(UC_ARM_REG_PC) < RETURN_LOWEST)
        fault("the processor faulted (unicorn exception %u: undefined instruction, SVC or breakpoint)", number);
    uc_emu_stop(uc);
}

/* ---- exceptions ----------------------------------------------------------------------------------- */

static void note_stack(uint32_t sp)
{
    if (counters.stack_limit && sp < counters.stack_limit)
        fault("the stack has run over its end: sp = 0x%08x, limit 0x%08x", sp, counters.stack_limit);
    if (sp < counters.stack_low)
        counters.stack_low = sp;
}

static const int FRAME_REGISTERS[FRAME_WORDS] = { UC_ARM_REG_R0,  UC_ARM_REG_R1, UC_ARM_REG_R2, UC_ARM_REG_R3,
                                                  UC_ARM_REG_R12, UC_ARM_REG_LR, UC_ARM_REG_PC, UC_ARM_REG_XPSR };

static void enter_exception(int exception)
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

static void return_from_exception(void)
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

/* ---- running -------------------------------------------------------------------------------------- */

/* Run unicorn until something wants attention. */
static void run_processor(void)
{
    core.wants_stop = 0;
    uint32_t from = core.pc;
    uc_err error = uc_emu_start(core.uc, from, RETURN_PAGE, 0, 0);
    if (core.wants_stop && !core.faulted)
        return; /* core.pc has been set by the block hook, or execution does not go on */
    core.pc = read_register(UC_ARM_REG_PC) | 1u;
    if (core.faulted)
        return;
    if (error != UC_ERR_OK) {
        fault("unicorn stopped: %s, pc = 0x%08x", uc_strerror(error), core.pc);
        return;
    }
    uint16_t before = 0;
    if (core.pc < RETURN_LOWEST && (memory_read((core.pc & ~1u) - 2u, &before, 2) || before != 0xbf30u))
        fault("unicorn stopped at 0x%08x for no known reason", core.pc);
    core.asleep = core.pc < RETURN_LOWEST; /* WFI */
}

static void sleep_on(void)
{
    if (nvic_wake()) {
        core.asleep = 0;
        return;
    }
    uint64_t due = next_due();
    uint64_t target = due << FRACTION_BITS;
    if (due == NEVER || target > core.until)
        target = core.until;
    if (target > core.time) {
        counters.idle_ticks += (target - core.time) >> FRACTION_BITS;
        core.time = target;
    }
    run_events();
    if (nvic_wake())
        core.asleep = 0;
}

static void run_stretch(void)
{
    run_events();
    while (core.time < core.until && core.powered && !core.faulted && !core.halted && !core.reset_asked) {
        if (core.asleep) {
            sleep_on();
            continue;
        }
        int exception = exception_to_take();
        if (exception)
            enter_exception(exception);
        if (core.faulted)
            break;
        run_processor();
        if (core.pc >= RETURN_LOWEST && !core.faulted)
            return_from_exception();
    }
    if (core.asleep && core.time >= core.until)
        run_events();
}

/* ---- set-up ---------------------------------------------------------------------------------------- */

static const char *map_memory(void)
{
    for (int i = 0; chip_regions[i].size; i++) {
        const struct chip_region *r = &chip_regions[i];
        uint32_t pages = (r->size + 4095u) & ~4095u;
        core.memory[i] = calloc(1, pages);
        core.blocks[i] = calloc(r->size / 2, sizeof(struct block));
        core.spent[i] = calloc(r->size / 2, sizeof(uint64_t));
        if (!core.memory[i] || !core.blocks[i] || !core.spent[i])
            return "no memory for the emulated chip";
        uint32_t rights = UC_PROT_READ | UC_PROT_EXEC | (r->writable ? UC_PROT_WRITE : 0u);
        if (uc_mem_map_ptr(core.uc, r->base & ~4095u, pages, rights, core.memory[i]))
            return "unicorn does not map the chip's memory";
    }
    return NULL;
}

static int map_io(uint32_t base, uint32_t size, int ppb)
{
    void *user = (void *)(uintptr_t)base;
    return uc_mmio_map(core.uc, base, size, ppb ? on_ppb_read : on_periph_read, user,
                       ppb ? on_ppb_write : on_periph_write, user) != UC_ERR_OK;
}

static const char *make_processor(void)
{
    static const uint16_t nops[2048];
    uc_hook hook;
    if (uc_open(UC_ARCH_ARM, UC_MODE_THUMB, &core.uc)
        || uc_ctl_set_cpu_model(core.uc, UC_CPU_ARM_CORTEX_M4))
        return "unicorn does not start";
    const char *error = map_memory();
    if (error)
        return error;
    if (map_io(0x40000000u, 0x20000000u, 0) || map_io(0xe0000000u, 0x100000u, 1)
        || uc_mem_map(core.uc, RETURN_PAGE, 0x1000, UC_PROT_READ | UC_PROT_EXEC)
        || uc_mem_write(core.uc, RETURN_PAGE, nops, sizeof nops))
        return "unicorn does not map the chip's registers";
    if (uc_hook_add(core.uc, &hook, UC_HOOK_BLOCK, (void *)on_block, NULL, 1, 0)
        || uc_hook_add(core.uc, &hook, UC_HOOK_INTR, (void *)on_interrupt, NULL, 1, 0)
        || uc_hook_add(core.uc, &hook, UC_HOOK_MEM_INVALID, (void *)on_bad_access, NULL, 1, 0))
        return "unicorn takes no hooks";
    return NULL;
}

static const char *load_segments(void)
{
    for (int i = 0; i < elf_segment_count; i++) {
        const struct elf_segment *s = &elf_segments[i];
        int r = region_of(s->address, s->size);
        if (r < 0 || chip_regions[r].writable)
            return "the image does not fit the chip's flash memory";
        memcpy(core.memory[r] + (s->address - chip_regions[r].base), s->data, s->size);
    }
    return NULL;
}

static uint32_t first_symbol(const char *const *names)
{
    for (; *names; names++) {
        uint32_t address = symbol_address(*names);
        if (address)
            return address;
    }
    return 0;
}

const char *emulator_load(const char *elf_path)
{
    static const char *const LIMITS[] = { "stack_limit", "_stack_limit", "__stack_limit" };
    const char *error = elf_load(elf_path);
    if (!error && !core.uc)
        error = make_processor();
    if (!error)
        error = load_segments();
    if (error)
        return error;
    core.loaded = 1;
    memset(&counters, 0, sizeof counters);
    counters.stack_low = UINT32_MAX;
    counters.stack_limit = first_symbol(LIMITS);
    return NULL;
}

static void power_on_memory(void)
{
    for (int i = 0; chip_regions[i].size; i++)
        if (chip_regions[i].writable)
            memset(core.memory[i], PAINT, chip_regions[i].size);
}

void sim_mcu_boot(const struct sim_board *outside, uint64_t clock)
{
    uint32_t cause = core.reset_cause;
    board = *outside;
    if (core.time >> FRACTION_BITS < clock)
        core.time = clock << FRACTION_BITS;
    core.halted = core.asleep = core.reset_asked = core.wants_stop = core.depth = 0;
    core.reset_cause = 0;
    if (!core.loaded) {
        fault("no image has been loaded into the emulated chip");
        return;
    }
    for (struct event *e = core.events; e; e = e->next)
        e->due = NEVER;
    if (!core.powered || (!cause && !chip_keeps_memory()))
        power_on_memory();
    core.powered = 1;
    core.until = core.time;
    nvic_reset();
    chip_reset(cause);
    uint32_t start[2];
    if (memory_read(chip_flash_base, start, sizeof start)) {
        fault("the image has no vector table");
        return;
    }
    /* After reset address 0 shows the flash memory; the model begins there directly. */
    ppb_write(0xe000ed08u, chip_flash_base);
    counters.stack_top = start[0];
    if (start[0] & 7u || region_of(start[0] - 8u, 8) < 0 || !(start[1] & 1u))
        fault("the vector table is wrong: stack 0x%08x, start 0x%08x", start[0], start[1]);
    for (int i = 0; i < 13; i++)
        write_register(UC_ARM_REG_R0 + i, 0xdeadbeefu);
    write_register(UC_ARM_REG_XPSR, 0x01000000u);
    write_register(UC_ARM_REG_CONTROL, 0);
    write_register(UC_ARM_REG_PRIMASK, 0);
    write_register(UC_ARM_REG_BASEPRI, 0);
    write_register(UC_ARM_REG_FAULTMASK, 0);
    write_register(UC_ARM_REG_SP, start[0]);
    write_register(UC_ARM_REG_LR, 0xffffffffu);
    core.pc = start[1];
}

uint64_t sim_mcu_next_event(void)
{
    if (!core.powered || core.faulted || core.halted || core.reset_asked)
        return NEVER;
    if (core.asleep && !nvic_wake())
        return next_due();
    return now();
}

void sim_mcu_advance(uint64_t clock)
{
    uint64_t target = (clock << FRACTION_BITS) + ((1u << FRACTION_BITS) - 1u); /* events at `clock` are within */
    if (target <= core.time || !core.powered || core.faulted || core.halted || core.reset_asked)
        return;
    uint64_t before = now();
    core.until = target;
    set_check();
    run_stretch();
    chip_sync();
    counters.ticks += now() - before;
}

void sim_mcu_receive(const uint8_t *data, uint32_t len)
{
    if (!core.powered || core.faulted || core.halted || core.reset_asked)
        return;
    counters.console_bytes_in += len;
    chip_receive(data, len);
}

int sim_mcu_take_reset(void)
{
    int asked = core.reset_asked && !core.faulted;
    if (asked)
        core.reset_asked = 0;
    return asked;
}

/* ---- emulator.h ------------------------------------------------------------------------------------- */

int emulator_fault(char *text, int size)
{
    if (!core.faulted)
        return 0;
    if (size > 0)
        snprintf(text, (size_t)size, "%s", core.fault_text);
    return 1;
}

/* The stack's space was painted at power-on: the lowest word that is something else was used. */
static void find_stack_low(void)
{
    if (!counters.stack_limit)
        return;
    uint8_t byte;
    for (uint32_t a = counters.stack_limit; a < counters.stack_top && !memory_read(a, &byte, 1); a++)
        if (byte != PAINT) {
            if (a < counters.stack_low)
                counters.stack_low = a;
            return;
        }
}

void emulator_counters(struct emulator_counters *out)
{
    if (core.powered)
        find_stack_low();
    *out = counters;
}

int emulator_mutate(const char *what, uint32_t value)
{
    return chip_mutate(what, value);
}

int emulator_peek(const char *what, uint32_t *value)
{
    if (*what != '=')
        return chip_peek(what, value);
    uint32_t address = symbol_address(what + 1);
    return address ? memory_read(address, value, sizeof *value) : -1;
}

int64_t emulator_profile(const char *symbol)
{
    uint32_t address = symbol[0] == '0' ? (uint32_t)strtoul(symbol, NULL, 16) : symbol_address(symbol) & ~1u;
    int i = address ? region_of(address, 2) : -1;
    if (i < 0)
        return -1;
    if (symbol[0] == '0')
        return (int64_t)core.spent[i][(address - chip_regions[i].base) >> 1];
    uint64_t sum = 0;
    uint32_t end = chip_regions[i].base + chip_regions[i].size;
    for (uint32_t a = address; a < end && !strcmp(symbol_at(a), symbol); a += 2)
        sum += core.spent[i][(a - chip_regions[i].base) >> 1];
    return (int64_t)sum;
}
