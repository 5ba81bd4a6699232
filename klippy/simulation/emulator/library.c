/* The library's interface: sim_mcu.h and emulator.h. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core_state.h"

static const char *load_segments(void)
{
    for (int i = 0; i < elf_segment_count; i++) {
        const struct elf_segment *s = &elf_segments[i];
        int r = region_of(s->address, s->size);
        if (r < 0 || chip_regions[r].writable)
            return "the image does not fit the chip's flash memory";
        memcpy(core.memory[r] + (s->address - chip_regions[r].base), s->data, s->size);
    }
    const struct elf_segment *rom = chip_rom();
    int r = region_of(rom->address, rom->size);
    memcpy(core.memory[r] + (rom->address - chip_regions[r].base), rom->data, rom->size);
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

static int peek_processor(const char *what, uint32_t *value)
{
    static const struct { const char *name; int number; } REGISTERS[] = {
        { "pc", UC_ARM_REG_PC }, { "sp", UC_ARM_REG_SP }, { "primask", UC_ARM_REG_PRIMASK },
    };
    for (size_t i = 0; i < sizeof REGISTERS / sizeof *REGISTERS; i++)
        if (!strcmp(what, REGISTERS[i].name)) {
            *value = read_register(REGISTERS[i].number);
            return 0;
        }
    return -1;
}

int emulator_peek(const char *what, uint32_t *value)
{
    if (!strncmp(what, "cpu.", 4))
        return peek_processor(what + 4, value);
    if (*what != '=')
        return chip_peek(what, value);
    uint32_t address = symbol_address(what + 1);
    return address ? memory_read(address, value, sizeof *value) : -1;
}

static struct emulator_record *records[RECORDS];

int emulator_record(const char *what, struct emulator_record *into)
{
    static const char *const NAMES[RECORDS] = { [RECORD_SAMPLES] = "samples", [RECORD_LAGS] = "lags" };
    for (int i = 0; i < RECORDS; i++)
        if (!strcmp(what, NAMES[i])) {
            records[i] = into;
            return 0;
        }
    return -1;
}

void record(enum record_kind kind, uint64_t clock, uint32_t value)
{
    struct emulator_record *r = records[kind];
    if (!r || r->count == r->capacity)
        return;
    r->clocks[r->count] = clock;
    r->values[r->count++] = value;
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
