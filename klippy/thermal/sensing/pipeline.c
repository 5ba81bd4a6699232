// One block after another through the thermal chain. See pipeline.h.

#include "pipeline.h"
#include <math.h>

#define QUANTISATION_VARIANCE (1.0 / 12.0) // LSB^2, a uniform rounding error
#define UNKNOWN_S 0.020                    // blocks missing for longer: the heat of that time is not known
#define LIMIT_DOUBT_C 5.0                  // a reading of more doubt passes a limit if it does by twice that doubt
#define ALIKE_BLOCKS 6.0                   // neighbours on one code err by the same: a message of them says it once

double
drive_power_w(double power_max_w, double exponent, double phase_max_ticks, double phase_ticks)
{
    return power_max_w * pow(sin(0.5 * M_PI * phase_ticks / phase_max_ticks), exponent);
}

static int
front_fault(const struct front_params *p, const struct coil_block *b)
{
    if (!b->phase_ticks)
        return BLOCK_OFF;
    if (b->min_raw <= 0 || b->max_raw >= p->adc_max_raw)
        return BLOCK_CLIPPED;
    return b->lost ? BLOCK_LOST : BLOCK_GOOD;
}

// Variance (LSB^2) of what rounding leaves in the mean of any number of samples of Gaussian noise, over all places
// between two codes. The error's first harmonic falls with exp(-(2 pi sigma)^2), the others faster (Widrow, Kollar,
// Liu, Statistical Theory of Quantization, IEEE Trans. Instrum. Meas. 45, 1996): nothing at 0.5 LSB, all at none.
static double
stuck_variance(double noise_lsb)
{
    double turns = 2.0 * M_PI * noise_lsb;
    return QUANTISATION_VARIANCE * exp(-turns * turns);
}

void
front_measure(const struct front_params *p, struct coil_block *blocks, int count)
{
    double variance = p->noise_lsb * p->noise_lsb + QUANTISATION_VARIANCE;
    double stuck = ALIKE_BLOCKS * stuck_variance(p->noise_lsb);
    for (struct coil_block *b = blocks; b < blocks + count; b++) {
        b->centre_s = b->time_s + 0.5 * b->duration_s;
        b->end_s = b->time_s + b->duration_s;
        b->signal_units = (b->mean_raw - p->adc_zero_raw) * p->units_per_lsb;
        b->noise_units = sqrt(variance / b->count + stuck) * p->units_per_lsb;
        b->fault = front_fault(p, b);
    }
}

void
chain_estimate(const struct chain_params *p, struct coil_block *b)
{
    b->temp_c = b->sigma_c = b->noise_c = b->c_per_unit = NAN;
    if (b->fault)
        return;
    if (b->phase_ticks < p->phase_low_ticks) {
        b->fault = BLOCK_FAINT;
        return;
    }
    struct sensing_reading read = sensing_invert(&p->law, b->signal_units, b->phase_ticks, p->supply);
    if (!(p->temp_low_c <= read.temp_c && read.temp_c <= p->temp_high_c)) {
        double empty = sensing_error(&p->law, p->empty_c, b->phase_ticks, p->supply);
        b->fault = b->signal_units > empty ? BLOCK_EMPTY : BLOCK_OUTSIDE;
        return;
    }
    b->temp_c = read.temp_c;
    b->sigma_c = hypot(hypot(b->noise_units, p->residual_units) * read.c_per_unit, read.error_c);
    b->noise_c = hypot(b->noise_units * read.c_per_unit, read.error_c); // the filter trusts drives that the law fits
    b->c_per_unit = read.c_per_unit;
}

void
chain_watch_block(const struct chain_params *p, struct chain_watch *w, const struct coil_block *b)
{
    w->last_block_s = b->end_s;
    if (w->is_tripped || b->fault == BLOCK_OFF)
        return; // with the bridge off nothing could be measured
    if (!p->is_calibrated) {
        w->last_valid_s = b->end_s;
        return;
    }
    w->fault = b->fault;
    if (b->fault)
        return;
    w->last_valid_s = b->end_s;
    double doubt_c = 2.0 * b->sigma_c;
    if (b->sigma_c > LIMIT_DOUBT_C && p->limit_low_c - doubt_c <= b->temp_c && b->temp_c <= p->limit_high_c + doubt_c)
        return; // looks within this drive decide
    int within = p->limit_low_c <= b->temp_c && b->temp_c <= p->limit_high_c;
    w->beyond = within ? 0 : w->beyond + 1;
    if (w->beyond >= p->limit_blocks) {
        w->is_tripped = 1;
        w->tripped_c = b->temp_c;
    }
}

void
chain_note_span(const struct chain_params *p, struct chain_state *s, const struct coil_block *b)
{
    if (!b->phase_ticks || b->count < p->span_samples / 2)
        return; // short cut ones say too little
    // A longer block spans more: expected extremes of n Gaussian samples go with sqrt(2 ln n).
    double span = (b->max_raw - b->min_raw) * sqrt(log(p->span_samples) / log(b->count));
    if (s->spans < p->span_blocks)
        s->spans++;
    s->span_lsb = s->spans == 1 ? span : s->span_lsb + (span - s->span_lsb) / s->spans;
}

double
chain_noise_lsb(const struct chain_params *p, const struct chain_state *s)
{
    return s->spans < p->span_blocks / 4 ? NAN : s->span_lsb / p->span_per_noise;
}

// Each block's own temperature for the predictive law, and the heat since the block before.
static struct model_sample
sample_of(const struct chain_params *p, struct chain_state *s, const struct coil_block *b)
{
    struct model_sample sample = {b->centre_s, b->end_s, NAN, 0.0, b->heat_w, 0};
    if (b->fault != BLOCK_GOOD)
        return sample;
    double ratio = b->phase_ticks / p->phase_max_ticks, away = ratio * ratio - s->usual_share;
    int jump = fabs(away) > p->step_share;
    s->usual_share += jump ? away : away * b->duration_s / (b->duration_s + p->usual_s);
    sample.temp_c = b->temp_c;
    sample.sigma_c = b->sigma_c; // with the law's residual, not the noise alone
    sample.is_rebased = (uint8_t)(jump && !p->has_looks);
    return sample;
}

int
chain_take(const struct chain_params *p, struct chain_state *s, struct coil_block *blocks, int count,
           struct model_sample *samples)
{
    int newest = -1;
    struct front_params front = p->front;
    double noise_lsb = chain_noise_lsb(p, s);
    if (!isnan(noise_lsb))
        front.noise_lsb = noise_lsb;
    front_measure(&front, blocks, count);
    for (int i = 0; i < count; i++) {
        struct coil_block *b = &blocks[i];
        chain_estimate(p, b);
        b->heat_w = drive_power_w(p->power_max_w, p->power_exponent, p->power_phase_max_ticks, b->phase_ticks);
        if (b->time_s - s->watch.last_block_s > UNKNOWN_S)
            s->heat_j = NAN;
        s->heat_j += b->heat_w * (b->duration_s + b->discarded * b->duration_s / b->count);
        if (p->has_looks)
            drive_offset_block(&s->drive, &p->filter, s->filter.rate_k_s, p->phase_max_ticks, b);
        chain_watch_block(p, &s->watch, b);
        witness_block(&s->witness, &p->filter, p->phase_max_ticks, b);
        chain_note_span(p, s, b);
        if (filter_block(&p->filter, &s->filter, b)) {
            b->tracked_sigma_c = hypot(b->tracked_sigma_c, p->drift_sigma_c);
            newest = i;
        }
        samples[i] = sample_of(p, s, b);
    }
    return newest;
}
