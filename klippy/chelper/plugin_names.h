#ifndef FERRITE_PLUGIN_NAMES_H
#define FERRITE_PLUGIN_NAMES_H
/* Functions of the helper library that plugins call by name, where this program has others for the purpose. */
#include "motion/trapq.h"

struct pull_move {                  /* a piece of constant acceleration, as struct trapq_span */
    double print_time, move_t, start_v, accel;
    double start_x, start_y, start_z, x_r, y_r, z_r;
};

struct trdispatch {                 /* names a group of boards that stop together; see link/plugin_trsync.py */
    int active;
};

int trapq_extract_old(const struct trapq *tq, struct pull_move *out, int max, double start_time, double end_time);
void trapq_finalize_moves(struct trapq *tq, double print_time, double clear_history_time);
struct trdispatch *trdispatch_alloc(void);
void trdispatch_start(struct trdispatch *td, uint32_t reason);
void trdispatch_stop(struct trdispatch *td);
void free(void *ptr);

#endif
