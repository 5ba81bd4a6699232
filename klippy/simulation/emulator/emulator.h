/* What an emulator library offers beside sim_mcu.h.
 *
 * An emulator is a library with the interface of a simulated MCU (src/simulator/sim_mcu.h) that runs the image a chip
 * would be flashed with.  It is strict: whatever the chip's manual forbids or the model does not have ends the run
 * with a sentence.  One library holds one chip; for several load several copies of the file.
 */
#ifndef EMULATOR_H
#define EMULATOR_H

#include <stdint.h>

#include "sim_mcu.h"

#ifdef __cplusplus
extern "C" {
#endif

enum { EMULATOR_VECTORS = 128, EMULATOR_BUCKETS = 24 };

/* All since the last emulator_load(), over resets. */
struct emulator_counters {
    uint64_t instructions;          /* executed */
    uint64_t interrupt_instructions; /* of these inside exception handlers */
    uint64_t ticks;                 /* of CLOCK_FREQ that have passed */
    uint64_t idle_ticks;            /* of these asleep */
    uint64_t interrupts;            /* exceptions taken */
    uint64_t console_bytes_in, console_bytes_out;
    uint64_t console_overruns;      /* received bytes lost because the firmware came too late */
    uint64_t samples, samples_lost; /* conversions in step with the bridge; overwritten before they were moved */
    uint32_t console_baud;          /* as the firmware has set it up; 0: not yet */
    uint32_t stack_low;             /* lowest stack address ever written */
    uint32_t stack_limit, stack_top;
    uint32_t resets;                /* asked for by the firmware or its watchdog */
    uint32_t phase_writes;          /* times that the bridge's phase in force changed */
    uint32_t worst_latency_ticks;   /* from an interrupt's request to its first instruction */
    /* Per exception number: how often, instructions in all and of its longest run (its own only), ticks from its first
     * instruction to its return (with what preempted it). */
    uint64_t count[EMULATOR_VECTORS], spent[EMULATOR_VECTORS];
    uint32_t longest_instructions[EMULATOR_VECTORS];
    uint32_t longest_ticks[EMULATOR_VECTORS];
};

/* Call before sim_mcu_boot().  Returns NULL or an error text. */
SIM_EXPORT const char *emulator_load(const char *elf_path);
/* 1 and its text if the model has objected to something; the chip then stands still. */
SIM_EXPORT int emulator_fault(char *text, int size);
SIM_EXPORT void emulator_counters(struct emulator_counters *out);

/* Break something: from now on, over resets, `what` is as `value` says.  0 on success, -1 if the chip has no such thing.
 * Names: see docs/reference/Emulation.md. */
SIM_EXPORT int emulator_mutate(const char *what, uint32_t value);
/* Registers as they stand, by the model's own names ("hrtim.phase", "hrtim.outputs", ...), or "=name": the word of a
 * variable of the image. 0 and *value, or -1. */
SIM_EXPORT int emulator_peek(const char *what, uint32_t *value);
/* Write down what happens from now on, up to `capacity` entries; `into` stays in use until it is given again or the
 * library is unloaded. "samples": every code that the converter in step with the bridge has been given, at its trigger's
 * clock. "lags": every change of the bridge, in steps of its timer between the legs, 0 off. -1: this chip has no such thing. */
struct emulator_record {
    uint64_t *clocks;
    uint32_t *values;
    uint32_t capacity, count;
};
SIM_EXPORT int emulator_record(const char *what, struct emulator_record *into);
/* Instructions spent in the function `symbol` itself since load, or in the basic block at "0xADDRESS". -1: no such function. */
SIM_EXPORT int64_t emulator_profile(const char *symbol);

#ifdef __cplusplus
}
#endif

#endif
