/* One direction of a line: bytes take time, arrive late by the latency, and may be damaged.
 *
 *   link_send ──► damage per byte ──► [chunk | chunk | ...] ──► link_take, once its last byte has arrived
 *
 * Pure: state, bytes and time in; bytes out. Order is kept (a line has no way to overtake).
 */
#ifndef FERRITE_WORLD_LINK_H
#define FERRITE_WORLD_LINK_H

#include <stdint.h>
#include "world_api.h"

enum {
    LINK_CHUNK_BYTES = 64,   /* one message block: nothing is gained by waiting for more */
    LINK_CHUNKS = 512,       /* 1.3 s of line at 250 kBd; what comes on top is lost, as in a full buffer */
};

struct link_chunk {
    double arrival_s;
    uint32_t length;
    uint8_t data[2 * LINK_CHUNK_BYTES]; /* every byte may be doubled */
};

struct link {
    struct world_link_options options;
    double byte_s;
    double free_s;    /* when the line has sent all it was given */
    double latest_s;  /* arrival of the newest chunk */
    double cut_until_s; /* what is sent before is lost */
    uint64_t random;  /* state of the generator */
    uint32_t first, count;
    uint64_t bytes, corrupted, dropped, duplicated, overflowed;
    struct link_chunk chunks[LINK_CHUNKS];
};

void link_init(struct link *l, const struct world_link_options *options, uint64_t seed);
void link_send(struct link *l, const uint8_t *data, uint32_t length, double now_s);
double link_next_s(const struct link *l); /* arrival of the oldest chunk, INFINITY if none */
const struct link_chunk *link_take(struct link *l, double now_s); /* oldest chunk if it has arrived, else NULL */
void link_clear(struct link *l);

/* Uniform in [0, 1), 53 bits; splitmix64 (Steele, Lea, Flood 2014). */
double random_uniform(uint64_t *state);
uint64_t random_bits(uint64_t *state);

#endif
