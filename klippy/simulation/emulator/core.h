/* What the files of an emulator share: time, events, the processor, the interrupt controller, faults.
 *
 * Time is counted in ticks of the firmware's clock (CLOCK_FREQ of its dictionary); an instruction takes
 * CORE_CYCLES_PER_INSTRUCTION cycles of the processor clock, whatever it is.
 */
#ifndef EMULATOR_CORE_H
#define EMULATOR_CORE_H

#include <stdarg.h>
#include <stdint.h>

#include "emulator.h"

#define NEVER UINT64_MAX

enum {
    CORE_TICK_HZ = 72000000,
    /* Cortex-M4 from flash at 72 MHz: two wait states, prefetch buffer, no cache.  An estimate, see docs/reference/Emulation.md. */
    CORE_CYCLES_PER_INSTRUCTION = 2,
    CORE_EXCEPTION_CYCLES = 12, /* entry and return each: Cortex-M4 TRM */
};

/* ---- the run (core.c) ---- */
extern struct sim_board board;          /* the world outside */
extern struct emulator_counters counters;
enum record_kind { RECORD_SAMPLES, RECORD_LAGS, RECORDS };
void record(enum record_kind kind, uint64_t clock, uint32_t value); /* emulator_record() */
uint64_t now(void);                     /* the chip's present, ticks */
void fault(const char *format, ...) __attribute__((format(printf, 1, 2)));
void core_set_cpu_hz(uint32_t hz);
/* The chip starts again: at once, from the reset vector.  `cause` is for the chip's reset flags. */
enum { RESET_SOFTWARE = 1, RESET_WATCHDOG = 2 };
void core_halt(const char *why);        /* stand still until the next boot, without objecting */
void core_reset(uint32_t cause);

/* ---- events: what happens at a clock ---- */
typedef void (*event_fn)(void *arg);
struct event {
    uint64_t due;       /* NEVER: not waiting */
    event_fn run;
    void *arg;
    struct event *next; /* all that are known */
    uint8_t known;
};
void event_at(struct event *e, uint64_t due); /* due NEVER: cancel */

/* ---- memory of the chip, as a DMA or debugger sees it; 0 or -1 ---- */
int memory_read(uint32_t address, void *data, uint32_t size);
int memory_write(uint32_t address, const void *data, uint32_t size);
uint8_t *core_memory(uint32_t address);     /* NULL: none there; also of memory the chip cannot write */
uint32_t symbol_address(const char *name); /* 0: none */
const char *symbol_at(uint32_t address);   /* the function there, "?" if unknown */
uint32_t core_where(void);                 /* about where the processor is */

/* ---- interrupt controller (nvic.c) ---- */
enum { EXC_RESET = 1, EXC_NMI, EXC_HARD_FAULT, EXC_SVC = 11, EXC_PENDSV = 14, EXC_SYSTICK = 15, EXC_IRQ0 = 16 };
void nvic_reset(void);
void nvic_line(unsigned irq, int level);   /* a peripheral's request line */
void nvic_pend(int exception);
int nvic_wake(void);                       /* something pending that ends WFI */
/* The exception to take now, 0 if none; primask and basepri are the processor's. */
int nvic_next(uint32_t primask, uint32_t basepri, uint32_t faultmask);
void nvic_enter(int exception);
void nvic_leave(int exception);
int nvic_active_count(void);
int nvic_top_active(void);
uint64_t nvic_pended_at(int exception);
uint32_t nvic_vector_table(void);
int nvic_any_pending(void);
uint32_t ppb_read(uint32_t address);
void ppb_write(uint32_t address, uint32_t value);

/* ---- the chip (its own folder) ---- */
struct chip_region { uint32_t base, size; int writable; const char *name; };
extern const struct chip_region chip_regions[]; /* memories, last has size 0 */
extern const uint32_t chip_flash_base;
void chip_reset(uint32_t cause);        /* all peripherals to their reset state; cause 0: power on */
uint32_t chip_read(uint32_t address, unsigned size);
void chip_write(uint32_t address, uint32_t value, unsigned size);
void chip_receive(const uint8_t *data, uint32_t length);
int chip_mutate(const char *what, uint32_t value);
int chip_peek(const char *what, uint32_t *value);
int chip_keeps_memory(void);            /* over a power-on: the supply only dipped */
void chip_sync(void);                   /* bring lazily made things up to now */
int chip_irq_exists(unsigned irq);
extern const char *const chip_irq_names[]; /* by irq number, NULL: none */

/* ---- image (elf.c) ---- */
const char *elf_load(const char *path); /* NULL or an error */
struct elf_segment { uint32_t address, size; const uint8_t *data; };
const struct elf_segment *chip_rom(void); /* what the chip comes with, beside the image */
extern struct elf_segment elf_segments[];
extern int elf_segment_count;

#endif
