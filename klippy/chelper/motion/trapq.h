#ifndef FERRITE_TRAPQ_H
#define FERRITE_TRAPQ_H
/*
 * Queue of planned motion.
 *
 * A trapezoidal move enters as up to three segments of constant acceleration (speed up, cruise,
 * slow down). Segments live in one growing ring, addressed by a running 64-bit number, so that
 *   - any number of readers (one per stepper) keep nothing but the number they have reached,
 *   - the past stays readable (position lookups) until it is explicitly forgotten.
 *
 *      first                    reader A   reader B          next
 *        |--- history ------------|----------|--- planned ----|
 *
 * Units: seconds of print_time, mm, mm/s, mm/s^2.
 */
#include <stddef.h>
#include <stdint.h>

struct segment {
    double start_time, duration;    /* print_time (s), length (s) */
    double speed, half_accel;       /* distance along the path after t: speed*t + half_accel*t*t */
    double origin[3];               /* position at start_time */
    double ratio[3];                /* direction: d(position)/d(distance) */
};

struct trapq {
    struct segment *ring;
    uint64_t first, next;           /* numbers of the oldest kept and of the next new segment */
    size_t mask;                    /* capacity - 1; the capacity is a power of two */
};

struct trapq_span {                 /* a segment as handed to Python (history, reports) */
    double print_time, duration, start_v, accel;
    double start_x, start_y, start_z, x_r, y_r, z_r;
};

static inline struct segment *
trapq_segment(const struct trapq *tq, uint64_t number)
{
    return &tq->ring[number & tq->mask];
}

struct trapq *trapq_alloc(void);
void trapq_free(struct trapq *tq);
void trapq_append(struct trapq *tq, double print_time,
                  double accel_t, double cruise_t, double decel_t,
                  double start_pos_x, double start_pos_y, double start_pos_z,
                  double axes_r_x, double axes_r_y, double axes_r_z,
                  double start_v, double cruise_v, double accel);
void trapq_set_position(struct trapq *tq, double print_time, double x, double y, double z);
void trapq_forget_before(struct trapq *tq, double print_time);
int trapq_extract(const struct trapq *tq, struct trapq_span *out, int max,
                  double start_time, double end_time);
int trapq_state_at(const struct trapq *tq, double print_time, double *pos_xyz, double *velocity);

#endif
