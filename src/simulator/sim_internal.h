/* Shared by the files of the simulator port. */
#ifndef SIM_INTERNAL_H
#define SIM_INTERNAL_H

#include <stdint.h>

#include "sim_mcu.h"

enum { SIM_PIN_COUNT = 128, SIM_RX_SIZE = 256, SIM_ARENA_SIZE = 256 * 1024, SIM_RAM_SIZE = 256 };

extern struct sim_board sim_board;
extern uint64_t sim_clock;          /* the MCU's present */
/* The present plus what the running task has waited in delay_ticks(); for the edges of waves made by hand. */
uint64_t sim_now(void);

#define SIM_NEVER UINT64_MAX
uint64_t sim_bridge_next_event(void);   /* bridge edge or half buffer; SIM_NEVER if none */
void sim_bridge_run(void);              /* what is due at sim_clock */

#endif
