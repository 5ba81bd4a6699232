/* The processor's state, shared by core.c (time, running), exception.c and library.c (the interface). */
#ifndef EMULATOR_CORE_STATE_H
#define EMULATOR_CORE_STATE_H

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

struct core_state {
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
};

extern struct core_state core;

int region_of(uint32_t address, uint32_t size); /* index into chip_regions, -1 */
uint64_t next_due(void);
void set_check(void);
void run_events(void);
void run_stretch(void);
const char *make_processor(void);
uint32_t read_register(int reg);
void write_register(int reg, uint32_t value);
void enter_exception(int exception);
void return_from_exception(void);

#endif
