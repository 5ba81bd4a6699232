/* The world's loop and its construction; ../README.md is the theory of operation. */
#include "world_internal.h"

#include <dlfcn.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#define NEVER_S 1e30
enum { TRANSMIT_CAPACITY = 4096 }; /* above SERIALQUEUE_TRANSMIT_MIN, so one call empties what may go */

/* ---- construction ----------------------------------------------------------------------------- */

int world_fail(struct world *w, const char *format, ...)
{
    va_list args;
    va_start(args, format);
    vsnprintf(w->error, sizeof w->error, format, args);
    va_end(args);
    return -1;
}

/* Independent generator states from the one seed of the run. */
uint64_t world_new_seed(struct world *w)
{
    uint64_t state = w->seed ^ (0x632be59bd9b4e019u * ++w->streams);
    return random_bits(&state);
}

struct world *world_new(double start_s, uint64_t seed)
{
    struct world *w = calloc(1, sizeof *w);
    if (!w)
        return NULL;
    w->start_s = w->now_s = start_s;
    w->seed = seed;
    w->tick = 1;
    w->lookahead_s = WORLD_LOOKAHEAD_MAX_S;
    for (int i = WORLD_SIGMA_C; i < WORLD_CHANNELS; i++)
        w->channels[i] = NAN;
    machine_init(&w->machine);
    w->channels[WORLD_MELT_TARGET_C] = NAN;
    world_trace_open(w, NULL, 100.0);
    return w;
}

void world_free(struct world *w)
{
    if (!w)
        return;
    world_trace_close(w);
    for (int i = 0; i < w->mcu_count; i++)
        world_mcu_unload(&w->mcus[i]);
    free(w);
}

const char *world_error(const struct world *w)
{
    return w->error;
}

double world_now(const struct world *w)
{
    return w->now_s;
}

static struct world_mcu *mcu_at(struct world *w, int index)
{
    return index >= 0 && index < w->mcu_count ? &w->mcus[index] : NULL;
}

int world_add_mcu(struct world *w, const char *library, double clock_hz, double clock_ppm,
                  const struct world_link_options *link)
{
    if (w->mcu_count == WORLD_MCUS)
        return world_fail(w, "more than %d simulated MCUs", WORLD_MCUS);
    struct world_mcu *m = &w->mcus[w->mcu_count];
    *m = (struct world_mcu){ .world = w, .index = w->mcu_count, .wake_s = NEVER_S };
    m->clock_hz = clock_hz * (1.0 + clock_ppm * 1e-6);
    m->clock_base_s = w->start_s;
    link_init(&m->down, link, world_new_seed(w));
    link_init(&m->up, link, world_new_seed(w));
    if (world_mcu_load(m, library)) {
        world_mcu_unload(m);
        return -1;
    }
    double crossing_s = link->latency_s + 5.0 * m->up.byte_s; /* the shortest block has five bytes */
    w->lookahead_s = fmax(WORLD_LOOKAHEAD_MIN_S, fmin(w->lookahead_s, crossing_s));
    return w->mcu_count++;
}

int world_set_chip_temperature(struct world *w, int mcu, double temp_c)
{
    if (!mcu_at(w, mcu))
        return world_fail(w, "chip temperature: no such MCU");
    w->machine.chip_temp_c[mcu] = temp_c;
    return 0;
}

int world_load_image(struct world *w, int mcu, const char *image)
{
    struct world_mcu *m = mcu_at(w, mcu);
    return m ? world_mcu_load_image(m, image) : world_fail(w, "image: no such MCU");
}

int world_failed(const struct world *w)
{
    return w->failed;
}

uintptr_t world_symbol(struct world *w, int mcu, const char *name)
{
    struct world_mcu *m = mcu_at(w, mcu);
    return m ? (uintptr_t)dlsym(m->library.handle, name) : 0;
}

int world_add_axis(struct world *w, const struct world_axis_options *options)
{
    int index = machine_add_axis(&w->machine, options);
    return index >= 0 ? index : world_fail(w, "axis: too many, or a pin or step distance out of range");
}

int world_couple_axes(struct world *w, int axis, int partner, double own_share, double partner_share)
{
    if (machine_couple_axes(&w->machine, axis, partner, own_share, partner_share))
        return world_fail(w, "there are no two such axes to be coupled");
    return 0;
}

int world_add_probe(struct world *w, const struct world_probe_options *options)
{
    int index = machine_add_probe(&w->machine, options, (uint32_t)world_new_seed(w));
    return index >= 0 ? index : world_fail(w, "probe: too many, no such axis, or a pin out of range");
}

int world_add_gauge(struct world *w, const struct world_gauge_options *options)
{
    int index = machine_add_gauge(&w->machine, options, (uint32_t)world_new_seed(w), w->now_s);
    return index >= 0 ? index : world_fail(w, "gauge: too many, no such probe, or a pin out of range");
}

double world_coil_temperature(const struct world *w, int gauge)
{
    const struct machine *m = &w->machine;
    return gauge >= 0 && gauge < m->gauge_count ? gauge_coil_c(&m->gauges[gauge], w->now_s) : NAN;
}

int world_add_frame(struct world *w, const struct world_frame *options)
{
    if (machine_add_frame(&w->machine, options, w->now_s))
        return world_fail(w, "frame: it needs axes X and Y");
    return 0;
}

int world_add_mount(struct world *w, const struct world_mount *options)
{
    if (machine_add_mount(&w->machine, options, world_new_seed(w)))
        return world_fail(w, "mount: it needs a frame, a nozzle, and one of the axes");
    return 0;
}

int world_add_accelerometer(struct world *w, const struct world_accelerometer_options *options)
{
    int index = machine_add_accelerometer(&w->machine, options, (uint32_t)world_new_seed(w));
    return index >= 0 ? index : world_fail(w, "accelerometer: too many, no frame, or an orientation or pin out of range");
}

int world_set_accelerometer_fault(struct world *w, int accelerometer, int fault)
{
    if (accelerometer < 0 || accelerometer >= w->machine.accelerometer_count)
        return world_fail(w, "there is no such accelerometer");
    w->machine.accelerometers[accelerometer].fault = fault;
    return 0;
}

int world_add_panel(struct world *w, const struct world_panel_options *options)
{
    int index = machine_add_panel(&w->machine, options);
    return index >= 0 ? index : world_fail(w, "display: too many, or a pin that is out of range or something else's");
}

int world_read_panel(struct world *w, int panel, uint16_t *out, uint32_t capacity)
{
    if (panel < 0 || panel >= w->machine.panel_count)
        return world_fail(w, "there is no such display");
    if (w->machine.panels[panel].lost)
        return world_fail(w, "a display has been sent more than is kept; nobody has read it");
    return (int)machine_read_panel(&w->machine, panel, out, capacity);
}

int world_set_input(struct world *w, struct world_pin pin, int level)
{
    if (machine_set_input(&w->machine, pin, level))
        return world_fail(w, "input: a pin that is out of range or something else's");
    return 0;
}

double world_frame_place(const struct world *w, int axis)
{
    const struct machine *m = &w->machine;
    return m->has_frame && axis >= 0 && axis < FRAME_AXES ? m->frame[axis].x : NAN;
}

double world_bed_height(const struct world *w, int probe, double x, double y)
{
    const struct machine *m = &w->machine;
    return probe >= 0 && probe < m->probe_count ? bed_height_mm(&m->probes[probe].options.bed, x, y) : NAN;
}

int world_add_fan(struct world *w, struct world_pin pin, double spin_up_s)
{
    int index = machine_add_fan(&w->machine, pin, spin_up_s, w->now_s);
    return index >= 0 ? index : world_fail(w, "fan: too many, or a pin out of range");
}

static struct feed feed_from(const struct machine *m, struct world_feed options)
{
    struct feed f = { .options = options };
    if (options.axis < 0 || options.axis >= m->axis_count)
        f.options.axis = -1;
    return f;
}

int world_add_nozzle(struct world *w, int mcu, const double *parameters, struct world_feed feed, int fan)
{
    struct machine *m = &w->machine;
    if (m->nozzle_count == MACHINE_NOZZLES || !mcu_at(w, mcu) || m->nozzle_of_mcu[mcu] >= 0)
        return world_fail(w, "nozzle: too many, no such MCU, or its bridge has a nozzle already");
    struct nozzle *n = &m->nozzles[m->nozzle_count];
    *n = (struct nozzle){ .fan = fan < m->fan_count ? fan : -1, .mcu = mcu, .time_s = w->now_s, .start_s = w->start_s };
    n->feed = feed_from(m, feed);
    plant_init(&n->plant, parameters, world_new_seed(w));
    m->nozzle_of_mcu[mcu] = m->nozzle_count;
    return m->nozzle_count++;
}

int world_add_load(struct world *w, const double *parameters, int is_bed, struct world_pin heater,
                   struct world_pin sensor, struct world_feed feed, int fan)
{
    struct machine *m = &w->machine;
    if (m->load_count == MACHINE_LOADS || sensor.mcu < 0 || sensor.mcu >= MACHINE_MCUS || sensor.pin < 0
        || sensor.pin >= MACHINE_PINS)
        return world_fail(w, "load: too many, or its sensor pin is out of range");
    int duty = machine_add_duty(m, heater, w->now_s);
    if (duty < 0)
        return world_fail(w, "load: its heater pin is out of range");
    struct load *l = &m->loads[m->load_count];
    *l = (struct load){ .fan = fan < m->fan_count ? fan : -1, .duty = duty, .is_bed = is_bed, .time_s = w->now_s };
    l->feed = feed_from(m, feed);
    thermal_load_init(&l->thermal, parameters, world_new_seed(w));
    m->pins[sensor.mcu][sensor.pin].role = PIN_THERMISTOR;
    m->pins[sensor.mcu][sensor.pin].target = (uint8_t)m->load_count;
    return m->load_count++;
}

int world_add_reference(struct world *w, const struct world_reference_options *options, struct world_pin pin)
{
    struct machine *m = &w->machine;
    if (m->reference_count == MACHINE_REFERENCES || options->nozzle < 0 || options->nozzle >= m->nozzle_count
        || !(options->tau_s > 0.0) || !(options->adc_volt > 0.0))
        return world_fail(w, "reference: too many, no such nozzle, or a figure that cannot be");
    if (pin.mcu < 0 || pin.mcu >= MACHINE_MCUS || pin.pin < 0 || pin.pin >= MACHINE_PINS)
        return world_fail(w, "reference: its pin is out of range");
    struct reference *r = &m->references[m->reference_count];
    const double skin_c = m->nozzles[options->nozzle].plant.skin_c;
    *r = (struct reference){ .options = *options, .temp_c = 25.0 + options->gain * (skin_c - 25.0) };
    r->noise = (uint32_t)world_new_seed(w);
    m->pins[pin.mcu][pin.pin].role = PIN_REFERENCE;
    m->pins[pin.mcu][pin.pin].target = (uint8_t)m->reference_count;
    return m->reference_count++;
}

int world_add_supply_sensor(struct world *w, int nozzle, struct world_pin pin, double full_scale_v)
{
    struct machine *m = &w->machine;
    if (nozzle < 0 || nozzle >= m->nozzle_count || !(full_scale_v > 0.0))
        return world_fail(w, "supply sensor: no such nozzle, or no full scale");
    if (pin.mcu < 0 || pin.mcu >= MACHINE_MCUS || pin.pin < 0 || pin.pin >= MACHINE_PINS)
        return world_fail(w, "supply sensor: its pin is out of range");
    m->pins[pin.mcu][pin.pin].role = PIN_SUPPLY;
    m->pins[pin.mcu][pin.pin].target = (uint8_t)nozzle;
    m->nozzles[nozzle].supply_full_scale_v = full_scale_v;
    return 0;
}

int world_add_supply_switch(struct world *w, int nozzle, const struct world_supply_switch_options *options)
{
    struct machine *m = &w->machine;
    const struct world_pin pin = options->enable;
    if (nozzle < 0 || nozzle >= m->nozzle_count || options->delay_s < 0.0 || options->watchdog_s < 0.0)
        return world_fail(w, "supply switch: no such nozzle, or a negative time");
    if (pin.mcu < 0 || pin.mcu >= MACHINE_MCUS || pin.pin < 0 || pin.pin >= MACHINE_PINS)
        return world_fail(w, "supply switch: its pin is out of range");
    struct machine_pin *p = &m->pins[pin.mcu][pin.pin];
    p->role = PIN_ENABLE;
    p->target = (uint8_t)nozzle;
    p->level = (uint8_t)(pin.inverted != 0);
    struct nozzle *n = &m->nozzles[nozzle];
    n->supply_switch = (struct supply_switch){ .options = *options, .present = 1 };
    plant_set_supply(&n->plant, 1);
    return 0;
}

/* One rule at a time: what is set or given a profile loses the one before. */
static void forget_profile(struct nozzle *n, int index)
{
    for (int i = 0; i < n->profile_count; i++)
        if (n->profiles[i].index == index)
            n->profiles[i--] = n->profiles[--n->profile_count];
}

int world_add_profile(struct world *w, int nozzle, int index, const double *times_s, const double *values, int count)
{
    struct machine *m = &w->machine;
    if (nozzle < 0 || nozzle >= m->nozzle_count || index < 0 || index >= plant_param_count)
        return world_fail(w, "profile: no such nozzle or parameter");
    struct nozzle *n = &m->nozzles[nozzle];
    forget_profile(n, index);
    if (n->profile_count == NOZZLE_PROFILES || count < 1 || count > PROFILE_POINTS)
        return world_fail(w, "profile: at most %d of a nozzle, each with 1 to %d points", NOZZLE_PROFILES, PROFILE_POINTS);
    struct profile *p = &n->profiles[n->profile_count++];
    *p = (struct profile){ .index = index, .count = count };
    memcpy(p->time_s, times_s, (size_t)count * sizeof *times_s);
    memcpy(p->value, values, (size_t)count * sizeof *values);
    return 0;
}

int world_parameter(int table, int index, const char **name, const char **unit, const char **doc, double *values)
{
    if (index < 0 || index >= (table ? thermal_load_param_count : plant_param_count))
        return 0;
    if (table) {
        const struct thermal_load_param *p = &thermal_load_params[index];
        *name = p->name, *unit = p->unit, *doc = p->doc;
        values[0] = p->min, values[1] = p->max, values[2] = p->hotend, values[3] = p->bed;
    } else {
        const struct plant_param *p = &plant_params[index];
        *name = p->name, *unit = p->unit, *doc = p->doc;
        values[0] = p->min, values[1] = p->max, values[2] = p->reference, values[3] = p->strong, values[4] = p->real;
    }
    return 1;
}

/* ---- the host's side of the links ------------------------------------------------------------- */

int world_attach(struct world *w, int mcu, uintptr_t queue, uintptr_t receive, uintptr_t transmit)
{
    struct world_mcu *m = mcu_at(w, mcu);
    if (!m || !queue || !receive || !transmit)
        return world_fail(w, "attach: no such MCU or no queue");
    m->queue = (void *)queue;
    m->receive = (world_receive_fn)receive;
    m->transmit = (world_transmit_fn)transmit;
    m->wake_s = w->now_s;
    return 0;
}

void world_detach(struct world *w, int mcu)
{
    struct world_mcu *m = mcu_at(w, mcu);
    if (m) {
        m->queue = NULL;
        m->wake_s = NEVER_S;
    }
}

void world_feed(struct world *w, int mcu, const uint8_t *data, uint32_t length)
{
    struct world_mcu *m = mcu_at(w, mcu);
    if (m)
        link_send(&m->down, data, length, w->now_s);
}

uint32_t world_drain(struct world *w, int mcu, uint8_t *data, uint32_t capacity)
{
    struct world_mcu *m = mcu_at(w, mcu);
    uint32_t length = 0;
    const struct link_chunk *c;
    while (m && !m->queue && capacity - length >= sizeof c->data && (c = link_take(&m->up, w->now_s))) {
        memcpy(data + length, c->data, c->length);
        length += c->length;
    }
    return length;
}

/* Let the host's queue put bytes on the line. */
static void pump(struct world *w, struct world_mcu *m)
{
    uint8_t buffer[TRANSMIT_CAPACITY];
    if (!m->queue || w->now_s < w->stalled_until_s)
        return;
    double wake_s = NEVER_S;
    int length;
    while ((length = m->transmit(m->queue, buffer, sizeof buffer, w->now_s, &wake_s)) > 0)
        link_send(&m->down, buffer, (uint32_t)length, w->now_s);
    m->wake_s = fmax(wake_s, w->now_s + WORLD_LOOKAHEAD_MIN_S);
}

/* ---- the loop --------------------------------------------------------------------------------- */

/* Where to stop next: nothing before that time may concern two parts of the world. */
static double next_stop_s(const struct world *w, double until_s)
{
    double first_event_s = INFINITY;
    double stop_s = fmin(until_s, w->start_s + (double)w->tick * WORLD_TICK_S);
    for (int i = 0; i < w->mcu_count; i++) {
        const struct world_mcu *m = &w->mcus[i];
        first_event_s = fmin(first_event_s, world_mcu_next_s(m));
        stop_s = fmin(stop_s, link_next_s(&m->down));
        if (m->queue && w->now_s >= w->stalled_until_s)
            stop_s = fmin(stop_s, fmin(link_next_s(&m->up), m->wake_s));
    }
    return fmax(w->now_s, fmin(stop_s, first_event_s + w->lookahead_s));
}

/* Deliver what has arrived for and from one MCU; 1 if its host queue holds messages now. */
static int deliver(struct world *w, struct world_mcu *m)
{
    const struct link_chunk *c;
    int waiting = 0;
    while ((c = link_take(&m->down, w->now_s)))
        world_mcu_receive(m, c->data, c->length);
    if (!m->queue || w->now_s < w->stalled_until_s)
        return 0;
    int received = 0;
    while ((c = link_take(&m->up, w->now_s))) {
        received = 1;
        if (m->receive(m->queue, c->data, (int)c->length, w->now_s) > 0)
            waiting = 1;
    }
    if (received || m->wake_s <= w->now_s)
        pump(w, m);
    return waiting;
}

static void tick_if_due(struct world *w)
{
    if (w->now_s < w->start_s + (double)w->tick * WORLD_TICK_S)
        return;
    w->tick++;
    machine_tick(&w->machine, w->now_s, WORLD_TICK_S);
    world_watch_tick(w);
    if (w->now_s >= w->trace.next_s)
        world_trace_row(w);
}

uint32_t world_advance(struct world *w, double until_s)
{
    uint32_t waiting = 0;
    for (int i = 0; i < w->mcu_count; i++) {
        if (!w->mcus[i].booted)
            world_mcu_advance(&w->mcus[i], w->now_s);
        pump(w, &w->mcus[i]);
    }
    while (w->now_s < until_s && !waiting) {
        double stop_s = next_stop_s(w, until_s);
        for (int i = 0; i < w->mcu_count; i++)
            world_mcu_advance(&w->mcus[i], stop_s);
        w->now_s = stop_s;
        for (int i = 0; i < w->mcu_count; i++)
            if (deliver(w, &w->mcus[i]))
                waiting |= 1u << i;
        tick_if_due(w);
    }
    return waiting;
}

/* ---- looking at it ---------------------------------------------------------------------------- */

void world_axis(const struct world *w, int axis, struct world_axis_state *out)
{
    memset(out, 0, sizeof *out);
    if (axis < 0 || axis >= w->machine.axis_count)
        return;
    const struct axis *a = &w->machine.axes[axis];
    *out = (struct world_axis_state){
        .position_mm = axis_position_mm(a),
        .steps_forward = a->forward,
        .steps_backward = a->backward,
        .steps_lost = a->lost,
    };
}

void world_link(const struct world *w, int mcu, struct world_link_state *out)
{
    memset(out, 0, sizeof *out);
    if (mcu < 0 || mcu >= w->mcu_count)
        return;
    const struct link *down = &w->mcus[mcu].down, *up = &w->mcus[mcu].up;
    *out = (struct world_link_state){
        .bytes_down = down->bytes,
        .bytes_up = up->bytes,
        .corrupted = down->corrupted + up->corrupted,
        .dropped = down->dropped + up->dropped,
        .duplicated = down->duplicated + up->duplicated,
        .overflowed = down->overflowed + up->overflowed,
    };
}

int world_nozzle(const struct world *w, int nozzle, struct world_nozzle_state *out)
{
    if (nozzle < 0 || nozzle >= w->machine.nozzle_count)
        return 0;
    const struct nozzle *n = &w->machine.nozzles[nozzle];
    struct plant_outputs now;
    plant_read(&n->plant, &now);
    *out = (struct world_nozzle_state){
        .skin_c = now.skin_c, .power_w = now.power_w, .supply_v = now.supply_v, .phase_ticks = n->phase,
        .supply_closed = !n->plant.supply_open,
    };
    return 1;
}

double world_nozzle_temperature(const struct world *w, int nozzle)
{
    struct plant_outputs out;
    if (nozzle < 0 || nozzle >= w->machine.nozzle_count)
        return NAN;
    plant_read(&w->machine.nozzles[nozzle].plant, &out);
    return out.skin_c;
}

void world_set_nozzle_parameter(struct world *w, int nozzle, int index, double value)
{
    if (nozzle < 0 || nozzle >= w->machine.nozzle_count || index < 0 || index >= plant_param_count)
        return;
    forget_profile(&w->machine.nozzles[nozzle], index);
    plant_set_param(&w->machine.nozzles[nozzle].plant, index, value);
}

double world_nozzle_parameter(const struct world *w, int nozzle, int index)
{
    return nozzle < 0 || nozzle >= w->machine.nozzle_count ? NAN : plant_get_param(&w->machine.nozzles[nozzle].plant, index);
}

void world_set_load_parameter(struct world *w, int load, int index, double value)
{
    if (load >= 0 && load < w->machine.load_count && index >= 0 && index < thermal_load_param_count)
        thermal_load_set_param(&w->machine.loads[load].thermal, index, value);
}

double world_load_temperature(const struct world *w, int load)
{
    struct thermal_load_outputs out;
    if (load < 0 || load >= w->machine.load_count)
        return NAN;
    thermal_load_read(&w->machine.loads[load].thermal, &out);
    return out.body_c;
}

double world_fan_speed(const struct world *w, int fan)
{
    return fan < 0 || fan >= w->machine.fan_count ? 0.0 : w->machine.fans[fan].speed;
}

void world_set_channel(struct world *w, int channel, double value)
{
    if (channel >= 0 && channel < WORLD_CHANNELS)
        w->channels[channel] = value;
}
