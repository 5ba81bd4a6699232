/* What the world's own files share. Python and tests see world_api.h only. */
#ifndef FERRITE_WORLD_INTERNAL_H
#define FERRITE_WORLD_INTERNAL_H

#include <math.h>
#include <stdint.h>
#include <stdio.h>

#include "machine.h"
#include "sim_mcu.h"
#include "world_api.h"
#include "world_link.h"

enum {
    WORLD_MCUS = 16,    /* a bit each in the result of world_advance() */
    WORLD_WATCHES = 32, /* faults of one run */
    WORLD_EPOCHS = 512, /* more targets than that in one run: the last record is reused */
};

/* Machine and thermal step; at most 1 ms so that the nozzle (180 K/s reference, 500 K/s strong) moves less than 0.5 K a step. */
static const double WORLD_TICK_S = 0.001;
/* Farthest an MCU may run ahead of the others, about one ADC half buffer (32 periods of 120 kHz). */
static const double WORLD_LOOKAHEAD_MAX_S = 0.00025;
static const double WORLD_LOOKAHEAD_MIN_S = 0.00002;

typedef int (*world_receive_fn)(void *queue, const uint8_t *data, int len, double now);
typedef int (*world_transmit_fn)(void *queue, uint8_t *out, int capacity, double now, double *next_wake);

/* The functions of one loaded copy of libferrite_mcu.so (sim_mcu.h), or of an emulator (with those of emulator.h). */
struct mcu_library {
    void *handle;
    void (*boot)(const struct sim_board *board, uint64_t clock);
    uint64_t (*next_event)(void);
    void (*advance)(uint64_t clock);
    void (*receive)(const uint8_t *data, uint32_t len);
    int (*take_reset)(void);
    const char *(*load_image)(const char *path); /* emulators only, else NULL */
    int (*fault)(char *text, int size);          /* likewise */
};

struct world_mcu {
    struct world *world;
    int index;
    struct mcu_library library;
    struct sim_board board;
    double clock_hz; /* true rate, drift included */
    double clock_base, clock_base_s; /* ticks at a world time, where that rate began */
    int booted;

    struct link down, up; /* to the MCU, to the host */
    void *queue;          /* the host's serial queue; NULL: bytes go by world_feed and world_drain */
    world_receive_fn receive;
    world_transmit_fn transmit;
    double wake_s;        /* when the queue wants to be asked again */
};

struct world_trace {
    FILE *file;
    double period_s, next_s;
    uint64_t row; /* of the next one: its time is row * period, free of rounding drift */
    struct world_figures figures;
    struct world_target_epoch epochs[WORLD_EPOCHS];
    int epoch_count;
    double band_since_s; /* within band without a break since then, < 0: not in band */
    double shown_since_s; /* the same of the host's estimate */
    double last_target_c;
};

struct world {
    double start_s, now_s;
    uint64_t seed, streams; /* streams: random generators handed out so far */
    char error[640];
    int failed;
    struct world_mcu mcus[WORLD_MCUS];
    int mcu_count;
    double lookahead_s;
    struct machine machine;
    uint64_t tick; /* of the next one */
    struct world_trace trace;
    double channels[WORLD_CHANNELS];
    double stalled_until_s; /* the host stands still */
    struct world_watch_state watches[WORLD_WATCHES];
    int watch_count;
};

/* world.c */
int world_fail(struct world *w, const char *format, ...) __attribute__((format(printf, 2, 3)));
uint64_t world_new_seed(struct world *w);

/* world_mcu.c: one MCU and its clock */
int world_mcu_load(struct world_mcu *m, const char *path);
int world_mcu_load_image(struct world_mcu *m, const char *image);
void world_mcu_unload(struct world_mcu *m);
double world_mcu_next_s(const struct world_mcu *m); /* world time of its next event, never before now */
void world_mcu_advance(struct world_mcu *m, double until_s);
void world_mcu_receive(struct world_mcu *m, const uint8_t *data, uint32_t length);

void world_mcu_reboot(struct world_mcu *m);

/* world_faults.c */
void world_watch_tick(struct world *w);

/* world_trace.c */
void world_trace_row(struct world *w);

#endif
