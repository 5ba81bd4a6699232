"""C declarations of the induction unit's pure files, for cffi; kept in step with src/*.h by hand."""

from __future__ import annotations

CDEF = """
struct ema { int32_t state; uint8_t shift; uint8_t primed; };
void ema_init(struct ema *f, uint8_t shift);
void ema_restart(struct ema *f);
uint32_t ema_update(struct ema *f, uint32_t input);

struct oversample_config { uint8_t y; uint8_t ema_shift; uint16_t settle_samples; uint16_t block_len; };
struct oversample_block {
    uint32_t first; uint32_t value; uint32_t sum; uint16_t count; uint16_t phase; uint16_t min, max;
    uint16_t discarded, lost;
};
struct oversample {
    struct oversample_config config;
    uint16_t block_len, cut_len;
    uint32_t sum, low, high, first;
    uint16_t count;
    uint16_t phase, settle_left, discarded, lost;
    struct ema ema;
};
uint8_t oversample_init(struct oversample *o, struct oversample_config config);
uint8_t oversample_step(struct oversample *o, uint16_t phase, struct oversample_block *block);
uint8_t oversample_gap(struct oversample *o, uint32_t count, struct oversample_block *block);
uint8_t oversample_feed(struct oversample *o, const uint16_t *samples, uint16_t count, uint32_t first,
                        uint16_t *taken, struct oversample_block *block);
void oversample_drop(struct oversample *o, const struct oversample_block *block);

struct phase_node { struct phase_node *next; uint32_t clock; uint32_t due; uint16_t phase; };
struct phase_step { uint32_t index; uint16_t phase; };
struct phase_track {
    uint16_t phase_max;
    struct phase_node *first, *last;
    uint16_t commanded; uint16_t at_sample; uint8_t head, tail;
    struct phase_step ring[64];
};
void phase_init(struct phase_track *t, uint16_t phase_max);
uint8_t phase_push(struct phase_track *t, struct phase_node *node, uint32_t earliest);
struct phase_node *phase_cut(struct phase_track *t, uint32_t clock);
struct phase_node *phase_pop_due(struct phase_track *t, uint32_t clock);
void phase_forget(struct phase_track *t);
void phase_applied(struct phase_track *t, uint32_t index, uint16_t phase);
uint16_t phase_run(struct phase_track *t, uint32_t index, uint16_t count, uint16_t *run);

struct guard_row { uint16_t phase, low, high; uint8_t trip_blocks; };
struct guard_input { uint32_t sum; uint16_t count, phase, min, max; };
struct guard {
    uint32_t max_duration; uint32_t fed_clock; uint32_t trip_value; uint16_t trip_count; uint16_t adc_max;
    uint8_t trip; uint8_t bad_blocks; uint8_t row_count; uint8_t powered;
    struct guard_row rows[12];
};
void guard_init(struct guard *g, uint16_t adc_max, uint32_t max_duration);
uint8_t guard_add_row(struct guard *g, struct guard_row row);
int guard_block(struct guard *g, const struct guard_input *block);
void guard_fed(struct guard *g, uint32_t clock, uint16_t phase);
uint32_t guard_deadline(const struct guard *g);
int guard_check_deadline(struct guard *g, uint32_t clock);

struct attention_expected { uint32_t sum; uint16_t phase; };
struct attention { struct attention_expected now, next; uint32_t limit; int32_t mean8; };
void attention_expect(struct attention *a, uint16_t phase, uint32_t sum, uint32_t limit);
uint8_t attention_block(struct attention *a, uint16_t phase, uint32_t sum);
"""
