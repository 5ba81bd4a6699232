/* Probes that measure instead of switching: a load cell at the nozzle, a coil above the bed; see machine.h.
 *
 *     axes ──► gap between nozzle and bed ──┬─► force = stiffness · depth + drift ──► conversion (its mean) + noise ──► chip
 *                                           └─► height of the coil ──► frequency ─┘
 *
 *   coil: L(h) = L0 (1 - k exp(-h / d)), f = 1 / (2 pi sqrt(L C)), times 1 + a (T - 25) + ... + b (T - 25) exp(-h / d): the
 *   resistance of coil and bed, the coil's and the capacitor's own change.
 *
 * A nozzle on the bed goes no deeper than the load cell, or the frame, gives way.
 */
#include <math.h>
#include <string.h>

#include "machine.h"

static const double ROOM_C = 25.0;
static const double COIL_SENSOR_FULL_C = 100.0; /* at full scale of the ADC */
static const double FRAME_GIVES = 0.9; /* of the way after contact, the nozzle's own part is the rest */

int machine_add_gauge(struct machine *m, const struct world_gauge_options *o, uint32_t seed, double now_s)
{
    const struct world_pin pins[] = { o->ready, o->clock, o->select, o->temperature };
    const int roles[] = { PIN_GAUGE, PIN_GAUGE_CLOCK, PIN_GAUGE_SELECT, PIN_COIL_SENSOR };
    if (m->gauge_count == MACHINE_GAUGES || o->kind < 0 || o->kind >= GAUGE_KINDS || o->probe < 0
        || o->probe >= m->probe_count)
        return -1;
    for (int i = 0; i < 4; i++) {
        if (pins[i].mcu < 0)
            continue;
        if (pins[i].mcu >= MACHINE_MCUS || pins[i].pin < 0 || pins[i].pin >= MACHINE_PINS)
            return -1;
        struct machine_pin *pin = &m->pins[pins[i].mcu][pins[i].pin];
        pin->role = (uint8_t)roles[i];
        pin->target = (uint8_t)m->gauge_count;
        pin->level = i == 2;
    }
    struct gauge *g = &m->gauges[m->gauge_count];
    *g = (struct gauge){ .options = *o, .noise = seed, .start_s = now_s, .time_s = now_s };
    gauge_chip_init(&g->chip, (enum gauge_kind)o->kind, o->clock_hz, o->rate_hz);
    return m->gauge_count++;
}

static double draw(struct gauge *g)
{
    double sum = -6.0;
    for (int i = 0; i < 12; i++) {
        g->noise = g->noise * 1664525u + 1013904223u;
        sum += g->noise / 4294967296.0;
    }
    return sum;
}

double gauge_coil_c(const struct gauge *g, double now_s)
{
    const struct world_gauge_options *o = &g->options;
    double temp_c = o->coil_c + o->coil_c_per_s * (now_s - g->start_s);
    return o->coil_c_per_s < 0.0 ? fmax(temp_c, o->coil_end_c) : fmin(temp_c, fmax(o->coil_end_c, o->coil_c));
}

static double frequency_hz(const struct gauge *g, double height_mm, double temp_c)
{
    const struct world_gauge_options *o = &g->options;
    double near = exp(-height_mm / o->decay_mm), warm = temp_c - ROOM_C;
    double drift = 1.0 + warm * (o->drift_per_k + o->drift_near_per_k * near) + warm * warm * (o->drift_per_k2 + warm * o->drift_per_k3);
    return o->free_hz / sqrt(1.0 - o->coupling * near) * drift;
}

/* Of full scale, or Hz. */
static double signal_now(const struct machine *m, const struct gauge *g, double now_s)
{
    const struct world_gauge_options *o = &g->options;
    const struct probe *p = &m->probes[o->probe];
    double gap = probe_gap_mm(m, p, 0.0, 0.0);
    if (g->chip.kind != GAUGE_LDC1612) {
        double force_g = gap < 0.0 ? -gap * o->stiffness_g_mm : 0.0;
        force_g += o->drift_g_s * (now_s - g->start_s) + o->tare_g;
        return force_g * o->counts_per_g / 8388608.0;
    }
    double coil_gap = probe_gap_mm(m, p, p->options.x_offset_mm, p->options.y_offset_mm);
    double height_mm = coil_gap + o->coil_mm + (gap < 0.0 ? -gap * FRAME_GIVES : 0.0);
    return frequency_hz(g, height_mm, gauge_coil_c(g, now_s));
}

static double noise_now(struct gauge *g)
{
    const struct world_gauge_options *o = &g->options;
    double scale = g->chip.kind == GAUGE_LDC1612 ? 1.0 : o->counts_per_g / 8388608.0;
    return o->noise * scale * draw(g);
}

static void advance_one(const struct machine *m, struct gauge *g, double now_s)
{
    double rate = gauge_chip_rate(&g->chip);
    if (rate <= 0.0) {
        g->time_s = now_s;
        g->next_s = 0.0;
        return;
    }
    double period_s = 1.0 / (rate * (1.0 + g->options.rate_error));
    if (g->next_s == 0.0 || g->next_s > now_s + 2.0 * period_s) { /* begins, or has another rate */
        g->next_s = now_s + period_s;
        g->sum = 0.0;
        g->time_s = now_s;
    }
    if (now_s <= g->time_s)
        return;
    double signal = signal_now(m, g, now_s); /* no step since time_s */
    while (g->next_s <= now_s) {
        double mean = (g->sum + signal * (g->next_s - g->time_s)) / period_s;
        gauge_chip_convert(&g->chip, mean + noise_now(g));
        g->sum = 0.0;
        g->time_s = g->next_s;
        g->next_s += period_s;
    }
    g->sum += signal * (now_s - g->time_s);
    g->time_s = now_s;
}

void gauges_advance(struct machine *m, double now_s)
{
    for (int i = 0; i < m->gauge_count; i++)
        advance_one(m, &m->gauges[i], now_s);
}

uint8_t gauge_level(struct machine *m, int index, double now_s)
{
    gauges_advance(m, now_s);
    return gauge_chip_ready(&m->gauges[index].chip);
}

void gauge_clock(struct machine *m, int index, uint8_t level, double now_s)
{
    gauges_advance(m, now_s);
    gauge_chip_clock(&m->gauges[index].chip, level);
}

uint16_t gauge_temperature_code(const struct machine *m, int index, double now_s)
{
    double share = gauge_coil_c(&m->gauges[index], now_s) / COIL_SENSOR_FULL_C;
    return (uint16_t)lround(4095.0 * fmin(fmax(share, 0.0), 1.0));
}

/* ---- buses ----------------------------------------------------------------------------------- */

int gauges_spi(struct machine *m, int mcu, uint8_t *data, uint32_t len, double now_s)
{
    for (int i = 0; i < m->gauge_count; i++) {
        struct world_pin p = m->gauges[i].options.select;
        if (p.mcu != mcu || m->pins[mcu][p.pin].level)
            continue;
        gauges_advance(m, now_s);
        gauge_chip_spi(&m->gauges[i].chip, data, len);
        advance_one(m, &m->gauges[i], now_s); /* it may have been started */
        return 1;
    }
    return 0;
}

int gauges_i2c(struct machine *m, int mcu, uint8_t address, const uint8_t *write, uint32_t write_len, uint8_t *read,
               uint32_t read_len, double now_s)
{
    for (int i = 0; i < m->gauge_count; i++) {
        struct gauge *g = &m->gauges[i];
        if (g->options.i2c_mcu != mcu || g->options.i2c_address != address)
            continue;
        gauges_advance(m, now_s);
        gauge_chip_i2c(&g->chip, write, write_len, read, read_len);
        advance_one(m, g, now_s); /* it may have been started */
        return 1;
    }
    return 0;
}
