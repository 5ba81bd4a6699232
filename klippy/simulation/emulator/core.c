/* The processor: unicorn with what it lacks around it (time, events, sleep; exceptions in exception.c).
 *
 *     sim_mcu_advance ──► run until the clock asked for:
 *         asleep:  jump to the next event
 *         awake:   uc_emu_start ──► at each basic block: time += instructions * cycles; events due are run;
 *                                   an exception to take, or the end of the stretch, stops unicorn before the block
 *                  exception:  frame on the stack, LR = EXC_RETURN, PC from the vector table
 *                  return:     a jump to the magic address aborts, which pops the frame
 *
 * Time moves only at the beginning of a block, by the whole block: a peripheral sees accesses of one block at one clock,
 * at most some tens of instructions late.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core_state.h"

struct sim_board board;
struct emulator_counters counters;

struct core_state core;

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

uint64_t next_due(void)
{
    uint64_t due = NEVER;
    for (const struct event *e = core.events; e; e = e->next)
        due = e->due < due ? e->due : due;
    return due;
}

void set_check(void)
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
void run_events(void)
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

int region_of(uint32_t address, uint32_t size)
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

uint32_t read_register(int reg)
{
    uint32_t value = 0;
    uc_reg_read(core.uc, reg, &value);
    return value;
}

void write_register(int reg, uint32_t value)
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

/* ---- running -------------------------------------------------------------------------------------- */

/* Run unicorn until a hook stops it. */
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

void run_stretch(void)
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

const char *make_processor(void)
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
