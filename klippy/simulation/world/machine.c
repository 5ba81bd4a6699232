/* Axes, switches, duties, fans and flow; see machine.h. */
#include "machine.h"

#include <math.h>
#include <string.h>

#include "chip_sensor.h"
#include "sim_mcu.h"

static const uint16_t ADC_OPEN = 4095; /* nothing connected: pulled up */
static const double ROOM_C = 25.0;

void machine_init(struct machine *m)
{
    memset(m, 0, sizeof *m);
    for (int i = 0; i < MACHINE_MCUS; i++) {
        m->nozzle_of_mcu[i] = -1;
        m->chip_temp_c[i] = ROOM_C;
    }
}

static struct machine_pin *pin_at(struct machine *m, struct world_pin p)
{
    if (p.mcu < 0 || p.mcu >= MACHINE_MCUS || p.pin < 0 || p.pin >= MACHINE_PINS)
        return NULL;
    return &m->pins[p.mcu][p.pin];
}

/* ---- axes ------------------------------------------------------------------------------------ */

int machine_add_axis(struct machine *m, const struct world_axis_options *o)
{
    struct machine_pin *step = pin_at(m, o->step);
    if (m->axis_count == MACHINE_AXES || !step || !pin_at(m, o->dir) || !(o->mm_per_step > 0.0))
        return -1;
    struct axis *a = &m->axes[m->axis_count];
    memset(a, 0, sizeof *a);
    a->options = *o;
    a->own_share = 1.0;
    step->role = PIN_STEP;
    step->target = (uint8_t)m->axis_count;
    step->level = (uint8_t)(o->step.inverted != 0); /* idle: no edge when firmware sets its pin up */
    struct machine_pin *endstop = pin_at(m, o->endstop);
    if (endstop) {
        endstop->role = PIN_SWITCH;
        endstop->target = (uint8_t)m->axis_count;
    }
    return m->axis_count++;
}

int machine_couple_axes(struct machine *m, int axis, int partner, double own_share, double partner_share)
{
    if (axis < 0 || partner < 0 || axis == partner || axis >= m->axis_count || partner >= m->axis_count)
        return -1;
    m->axes[axis].partner = &m->axes[partner];
    m->axes[axis].own_share = own_share;
    m->axes[axis].partner_share = partner_share;
    return 0;
}

static double motor_way_mm(const struct axis *a)
{
    return (double)a->step * a->options.mm_per_step;
}

double axis_position_mm(const struct axis *a)
{
    double way = a->own_share * motor_way_mm(a);
    if (a->partner)
        way += a->partner_share * motor_way_mm(a->partner);
    return a->options.start_mm + way;
}

/* Does a hard stop keep the carriage from going on by `way_mm`? Half a step of play absorbs rounding. */
static int is_stopped(const struct axis *a, double way_mm)
{
    const struct world_axis_options *o = &a->options;
    if (!o->limited || way_mm == 0.0)
        return 0;
    double position = axis_position_mm(a) + 0.5 * way_mm;
    return way_mm > 0.0 ? position > o->max_mm : position < o->min_mm;
}

static void axis_step(struct machine *m, struct axis *a, int forward)
{
    double way_mm = forward ? a->options.mm_per_step : -a->options.mm_per_step;
    int stopped = is_stopped(a, a->own_share * way_mm);
    for (int i = 0; i < m->axis_count && !stopped; i++) /* carriages that this motor takes part in */
        if (m->axes[i].partner == a)
            stopped = is_stopped(&m->axes[i], m->axes[i].partner_share * way_mm);
    a->forward += forward;
    a->backward += !forward;
    if (stopped)
        a->lost++;
    else
        a->step += forward ? 1 : -1;
}

static void step_pin_changed(struct machine *m, int mcu, const struct machine_pin *pin)
{
    struct axis *a = &m->axes[pin->target];
    const struct world_axis_options *o = &a->options;
    int active = pin->level != (o->step.inverted != 0);
    if (!active && !o->both_edges)
        return;
    int dir_level = m->pins[mcu][o->dir.pin].level;
    axis_step(m, a, dir_level != (o->dir.inverted != 0));
}

static uint8_t switch_level(const struct axis *a)
{
    const struct world_axis_options *o = &a->options;
    double position = axis_position_mm(a);
    int closed = o->endstop_at_max ? position >= o->endstop_mm : position <= o->endstop_mm;
    return (uint8_t)(closed != (o->endstop.inverted != 0));
}

/* ---- duties and fans ------------------------------------------------------------------------- */

int machine_add_duty(struct machine *m, struct world_pin p, double now_s)
{
    struct machine_pin *pin = pin_at(m, p);
    if (m->duty_count == MACHINE_DUTIES || !pin)
        return -1;
    pin->role = PIN_DUTY;
    pin->target = (uint8_t)m->duty_count;
    m->duties[m->duty_count] = (struct duty){ .inverted = p.inverted, .since_s = now_s, .mean_since_s = now_s };
    return m->duty_count++;
}

int machine_add_fan(struct machine *m, struct world_pin pin, double spin_up_s, double now_s)
{
    if (m->fan_count == MACHINE_FANS)
        return -1;
    int duty = machine_add_duty(m, pin, now_s);
    if (duty < 0)
        return -1;
    m->fans[m->fan_count] = (struct fan){ .duty = duty, .spin_up_s = spin_up_s };
    return m->fan_count++;
}

/* `level`: electrical, 0..1 */
static void duty_set(struct duty *d, double level, double now_s)
{
    d->on_s += d->level * (now_s - d->since_s);
    d->since_s = now_s;
    d->level = d->inverted ? 1.0 - level : level;
}

/* Mean since the last call. */
static double duty_take(struct duty *d, double now_s)
{
    double span_s = now_s - d->mean_since_s;
    if (span_s <= 0.0)
        return d->level;
    double mean = (d->on_s + d->level * (now_s - d->since_s)) / span_s;
    d->on_s = 0.0;
    d->since_s = d->mean_since_s = now_s;
    return fmin(fmax(mean, 0.0), 1.0);
}

/* ---- what pins do ---------------------------------------------------------------------------- */

/* ---- switch in a bridge's supply ------------------------------------------------------------- */

static void switch_ask(struct supply_switch *s, int asked, double now_s)
{
    if (asked == s->asked)
        return;
    s->asked = asked;
    s->asked_s = now_s;
}

static void switch_edge(struct supply_switch *s, uint8_t level, double now_s)
{
    s->edge_s = now_s;
    switch_ask(s, s->options.watchdog_s > 0.0 || level != (s->options.enable.inverted != 0), now_s);
}

void machine_pin_write(struct machine *m, int mcu, uint32_t number, uint8_t value, double now_s)
{
    if (number >= MACHINE_PINS)
        return;
    struct machine_pin *pin = &m->pins[mcu][number];
    value = value != 0;
    if (pin->level == value)
        return;
    pin->level = value;
    if (pin->role == PIN_STEP) {
        frame_advance(m, now_s);
        gauges_advance(m, now_s);
        step_pin_changed(m, mcu, pin);
    } else if (pin->role == PIN_DUTY)
        duty_set(&m->duties[pin->target], value, now_s);
    else if (pin->role == PIN_CONTROL)
        probe_control(&m->probes[pin->target], value, now_s);
    else if (pin->role == PIN_ENABLE)
        switch_edge(&m->nozzles[pin->target].supply_switch, value, now_s);
    else if (pin->role == PIN_SELECT)
        accelerometer_select(&m->accelerometers[pin->target], value);
    else if (pin->role == PIN_GAUGE_CLOCK)
        gauge_clock(m, pin->target, value, now_s);
    else if (pin->role == PIN_GAUGE_SELECT && !value)
        gauge_chip_select(&m->gauges[pin->target].chip);
    else if (pin->role == PIN_PANEL)
        panel_pin_changed(m, &m->panels[pin->target], mcu, number, value);
}

void machine_pwm_write(struct machine *m, int mcu, uint32_t number, double level, double now_s)
{
    if (number >= MACHINE_PINS || m->pins[mcu][number].role != PIN_DUTY)
        return;
    duty_set(&m->duties[m->pins[mcu][number].target], level, now_s);
}

uint8_t machine_pin_read(struct machine *m, int mcu, uint32_t number, double now_s)
{
    if (number >= MACHINE_PINS)
        return 0;
    const struct machine_pin *pin = &m->pins[mcu][number];
    if (pin->role == PIN_PROBE)
        return probe_level(m, &m->probes[pin->target], now_s);
    if (pin->role == PIN_GAUGE)
        return gauge_level(m, pin->target, now_s);
    return pin->role == PIN_SWITCH ? switch_level(&m->axes[pin->target]) : pin->level;
}

/* About Gaussian: the sum of four uniform numbers has a standard deviation of 1/sqrt(3) of their width. */
static double reference_noise(struct reference *r)
{
    double sum = 0.0;
    for (int i = 0; i < 4; i++) {
        r->noise = r->noise * 1664525u + 1013904223u;
        sum += r->noise / 4294967296.0 - 0.5;
    }
    return sum * 1.7320508075688772;
}

static uint16_t reference_code(struct reference *r)
{
    const struct world_reference_options *o = &r->options;
    double code = r->temp_c * o->volt_per_k / o->adc_volt * 4095.0 + o->noise_lsb * reference_noise(r);
    return (uint16_t)lround(fmin(fmax(code, 0.0), 4095.0));
}

static uint16_t supply_code(struct nozzle *n)
{
    return (uint16_t)lround(4095.0 * fmin(fmax(effects_bus_code(&n->plant, n->supply_full_scale_v), 0.0), 1.0));
}

uint16_t machine_adc_read(struct machine *m, int mcu, uint32_t number, double now_s)
{
    /* a load is at most one tick behind: far below its lag */
    if (number == SIM_PIN_TEMPERATURE)
        return chip_sensor_code(m->chip_temp_c[mcu]);
    if (number < MACHINE_PINS && m->pins[mcu][number].role == PIN_REFERENCE)
        return reference_code(&m->references[m->pins[mcu][number].target]);
    if (number < MACHINE_PINS && m->pins[mcu][number].role == PIN_SUPPLY)
        return supply_code(&m->nozzles[m->pins[mcu][number].target]);
    if (number < MACHINE_PINS && m->pins[mcu][number].role == PIN_COIL_SENSOR)
        return gauge_temperature_code(m, m->pins[mcu][number].target, now_s);
    if (number >= MACHINE_PINS || m->pins[mcu][number].role != PIN_THERMISTOR)
        return ADC_OPEN;
    uint16_t code;
    thermal_load_sample(&m->loads[m->pins[mcu][number].target].thermal, &code, 1);
    return code;
}

void machine_reset_outputs(struct machine *m, int mcu, double now_s)
{
    for (uint32_t number = 0; number < MACHINE_PINS; number++) {
        struct machine_pin *pin = &m->pins[mcu][number];
        if (pin->role == PIN_DUTY) {
            struct duty *d = &m->duties[pin->target];
            duty_set(d, d->inverted ? 1.0 : 0.0, now_s); /* boards hold a heater off while its pin floats */
        } else if (pin->role == PIN_ENABLE) {
            struct supply_switch *s = &m->nozzles[pin->target].supply_switch;
            pin->level = (uint8_t)(s->options.enable.inverted != 0);
            switch_ask(s, 0, now_s);
        }
    }
    machine_bridge_set(m, mcu, 0, now_s);
}

/* ---- nozzle ---------------------------------------------------------------------------------- */

static void advance_plant(struct nozzle *n, double now_s)
{
    double dt = now_s - n->time_s;
    if (dt <= 0.0)
        return;
    n->time_s = now_s;
    plant_advance(&n->plant, dt);
}

void nozzle_advance(struct nozzle *n, double now_s)
{
    struct supply_switch *s = &n->supply_switch;
    if (s->present && s->asked && s->options.watchdog_s > 0.0 && now_s > s->edge_s + s->options.watchdog_s)
        switch_ask(s, 0, s->edge_s + s->options.watchdog_s);
    if (s->present && s->asked != s->closed && now_s >= s->asked_s + s->options.delay_s) {
        advance_plant(n, s->asked_s + s->options.delay_s);
        s->closed = s->asked;
        plant_set_supply(&n->plant, !s->closed);
    }
    advance_plant(n, now_s);
}

void machine_bridge_set(struct machine *m, int mcu, uint16_t phase, double now_s)
{
    int index = m->nozzle_of_mcu[mcu];
    if (index < 0)
        return;
    struct nozzle *n = &m->nozzles[index];
    nozzle_advance(n, now_s);
    n->phase = phase;
    plant_set_phase(&n->plant, phase);
}

/* Where the cable and the motors of X and Y are. */
static void place_head(const struct machine *m, struct plant *p)
{
    double place = 0.0, way_mm = 0.0;
    for (int i = 0; i < m->axis_count; i++) {
        const struct world_axis_options *o = &m->axes[i].options;
        if (o->role != WORLD_AXIS_X && o->role != WORLD_AXIS_Y)
            continue;
        double at_mm = axis_position_mm(&m->axes[i]);
        way_mm += at_mm;
        if (o->role == WORLD_AXIS_X && o->limited && o->max_mm > o->min_mm)
            place = 2.0 * (at_mm - o->min_mm) / (o->max_mm - o->min_mm) - 1.0;
    }
    plant_set_head(p, place, way_mm);
}

static void follow_profiles(struct nozzle *n, double now_s)
{
    for (int i = 0; i < n->profile_count; i++) {
        const struct profile *p = &n->profiles[i];
        int k = 0;
        while (k < p->count && p->time_s[k] <= now_s - n->start_s)
            k++;
        double value = p->value[k < p->count ? k : k - 1];
        if (k > 0 && k < p->count) {
            double share = (now_s - n->start_s - p->time_s[k - 1]) / (p->time_s[k] - p->time_s[k - 1]);
            value = p->value[k - 1] + share * (value - p->value[k - 1]);
        }
        if (value != plant_get_param(&n->plant, p->index))
            plant_set_param(&n->plant, p->index, value);
    }
}

void machine_sample(struct machine *m, int mcu, uint16_t *out, uint32_t count, double first_s, double period_s)
{
    int index = m->nozzle_of_mcu[mcu];
    if (index < 0) {
        memset(out, 0, count * sizeof *out);
        return;
    }
    struct nozzle *n = &m->nozzles[index];
    nozzle_advance(n, first_s);
    if (n->plant.effects.moves)
        place_head(m, &n->plant);
    plant_sample(&n->plant, out, count, period_s);
}

void machine_move_sampling(struct machine *m, int mcu, double late_s)
{
    int index = m->nozzle_of_mcu[mcu];
    if (index >= 0)
        plant_move_sampling(&m->nozzles[index].plant, 1e9 * late_s);
}

/* ---- once a millisecond ---------------------------------------------------------------------- */

/* Flow at the motor during the last tick; the plants even out single steps by their own compliance. */
static void feed_tick(const struct machine *m, struct feed *f, double tick_s)
{
    if (f->options.axis < 0)
        return;
    const struct axis *a = &m->axes[f->options.axis];
    double volume = 0.0;
    if (a->step > f->mark) {
        volume = (double)(a->step - f->mark) * a->options.mm_per_step * f->options.filament_area_mm2;
        f->mark = a->step;
    }
    f->volume_mm3 += volume;
    f->flow_mm3_s = volume / tick_s;
}

static double fan_speed(const struct machine *m, int fan)
{
    return fan < 0 ? 0.0 : m->fans[fan].speed;
}

void machine_tick(struct machine *m, double now_s, double tick_s)
{
    frame_advance(m, now_s);
    for (int i = 0; i < m->fan_count; i++) {
        struct fan *f = &m->fans[i];
        double drive = duty_take(&m->duties[f->duty], now_s);
        if (!f->stuck)
            f->speed += (drive - f->speed) * (f->spin_up_s > 0.0 ? 1.0 - exp(-tick_s / f->spin_up_s) : 1.0);
    }
    for (int i = 0; i < m->nozzle_count; i++) {
        struct nozzle *n = &m->nozzles[i];
        nozzle_advance(n, now_s);
        follow_profiles(n, now_s);
        feed_tick(m, &n->feed, tick_s);
        plant_set_inputs(&n->plant, n->feed.flow_mm3_s, fan_speed(m, n->fan));
    }
    mount_tick(m);
    for (int i = 0; i < m->reference_count; i++) {
        struct reference *r = &m->references[i];
        double seen_c = ROOM_C + r->options.gain * (m->nozzles[r->options.nozzle].plant.skin_c - ROOM_C);
        r->temp_c += (seen_c - r->temp_c) * (1.0 - exp(-tick_s / r->options.tau_s));
    }
    for (int i = 0; i < m->load_count; i++) {
        struct load *l = &m->loads[i];
        feed_tick(m, &l->feed, tick_s);
        l->duty_mean = duty_take(&m->duties[l->duty], now_s);
        thermal_load_set_duty(&l->thermal, l->duty_mean);
        thermal_load_set_inputs(&l->thermal, l->feed.flow_mm3_s, fan_speed(m, l->fan));
        thermal_load_advance(&l->thermal, now_s - l->time_s);
        l->time_s = now_s;
    }
}
