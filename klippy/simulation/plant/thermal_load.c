// A conventional heater with a thermistor: two heat capacities, a lagging sensor, a voltage divider.
//
//   Ce dTe/dt = P duty - k (Te - Tb) - ge (Te - Ta)                                    element (cartridge; bed plate)
//   Cb dTb/dt = k (Te - Tb) - (gb + fan g_fan)(Tb - Ta) - Q                            body (heater block; bed sheet)
//   tau dTs/dt = Ta + gain (Tb - Ta) - Ts                                              sensor
//   Q = mc (Tb - Tin)(1 - exp(-UA/mc)),  mc = rho c flow                               melt
//   R = R25 exp(beta (1/Ts - 1/298.15 K)),  code = max R' / (R' + pullup),  R' = R + inline
//
// The hotend's figures are fitted to Table 5 (conventional column) of Oskolkov 2021: C = 17 J/K, loss time
// constant 241.5 s, which gives five of the seven rows within 0.2 s; the other two (300 to 250: 34 s, and 250 to 50:
// 450 s) contradict those five, whatever the model. The bed's are engineering assumptions (thermal_load.h).
// The two nodes are solved by the midpoint rule in steps of at most a tenth of the fastest time constant.
#include "thermal_load.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static const double kelvin = 273.15, reference_k = 298.15;

const struct thermal_load_param thermal_load_params[] = {
#define THERMAL_LOAD_ROW(name, unit, hotend, bed, lo, hi, doc) {#name, unit, doc, hotend, bed, lo, hi},
    THERMAL_LOAD_TABLE(THERMAL_LOAD_ROW)
#undef THERMAL_LOAD_ROW
};
const int thermal_load_param_count = THERMAL_LOAD_PARAM_COUNT;

_Static_assert(sizeof(struct thermal_load_values) == THERMAL_LOAD_PARAM_COUNT * sizeof(double),
               "values must be a plain array");

static int fault_is(const struct thermal_load *l, enum thermal_load_fault fault)
{
    return (int)(l->v.fault + 0.5) == (int)fault;
}

void thermal_load_init(struct thermal_load *l, const double *values, uint64_t seed)
{
    memset(l, 0, sizeof(*l));
    memcpy(&l->v, values, sizeof(l->v));
    l->element_c = l->body_c = l->sensor_c = l->v.start_c;
    noise_seed(&l->noise, seed);
}

struct thermal_load *thermal_load_new(void)
{
    return calloc(1, sizeof(struct thermal_load));
}

void thermal_load_free(struct thermal_load *l)
{
    free(l);
}

int thermal_load_param_index(const char *name)
{
    for (int i = 0; i < thermal_load_param_count; i++)
        if (strcmp(thermal_load_params[i].name, name) == 0)
            return i;
    return -1;
}

double thermal_load_get_param(const struct thermal_load *l, int index)
{
    double values[THERMAL_LOAD_PARAM_COUNT];
    memcpy(values, &l->v, sizeof(values));
    return index >= 0 && index < THERMAL_LOAD_PARAM_COUNT ? values[index] : NAN;
}

void thermal_load_set_param(struct thermal_load *l, int index, double value)
{
    if (index >= 0 && index < THERMAL_LOAD_PARAM_COUNT)
        memcpy((char *)&l->v + (size_t)index * sizeof(double), &value, sizeof(value));
}

void thermal_load_set_duty(struct thermal_load *l, double duty)
{
    l->duty = fmin(fmax(duty, 0.0), 1.0);
}

void thermal_load_set_inputs(struct thermal_load *l, double flow_mm3_s, double fan)
{
    l->flow_in = fmax(flow_mm3_s, 0.0);
    l->fan = fmin(fmax(fan, 0.0), 1.0);
}

static double heater_power(const struct thermal_load *l)
{
    if (fault_is(l, THERMAL_LOAD_HEATER_BROKEN))
        return 0;
    const double duty = fault_is(l, THERMAL_LOAD_HEATER_STUCK) ? 1 : l->duty;
    const double resistance = fmax(1 + l->v.heater_tempco * (l->element_c - 20), 0.1);
    return duty * l->v.heater_w * l->v.supply_factor * l->v.supply_factor / resistance;
}

static double melt_conductance(const struct thermal_load *l)
{ // W/K between body and filament entry
    const double mc_w_k = 1e-3 * l->v.melt_heat_mj_m3k * l->flow;
    return mc_w_k <= 1e-12 ? 0 : mc_w_k * -expm1(-l->v.melt_ua_w_k / mc_w_k);
}

struct load_flows {
    double element_w, body_w, to_air_w, melt_w;
};

static struct load_flows load_flows(const struct thermal_load *l, double power_w, double melt_w_k, double element_c,
                                    double body_c)
{
    const struct thermal_load_values *v = &l->v;
    const double link_w = v->link_w_k * (element_c - body_c);
    const double element_air_w = v->loss_factor * v->element_loss_w_k * (element_c - v->ambient_c);
    const double body_air_w = (v->loss_factor * v->loss_w_k + l->fan * v->fan_w_k) * (body_c - v->ambient_c);
    const double melt_w = melt_w_k * (body_c - v->melt_in_c);
    return (struct load_flows){power_w - link_w - element_air_w, link_w - body_air_w - melt_w,
                               element_air_w + body_air_w, melt_w};
}

static void load_step(struct thermal_load *l, double dt_s)
{
    const struct thermal_load_values *v = &l->v;
    const double element_j_k = v->element_j_k * v->mass_factor, body_j_k = v->body_j_k * v->mass_factor;
    l->flow = v->flow_tau_s > 0 ? l->flow_in + (l->flow - l->flow_in) * exp(-dt_s / v->flow_tau_s) : l->flow_in;
    const double power_w = heater_power(l), melt_w_k = melt_conductance(l);
    const struct load_flows start = load_flows(l, power_w, melt_w_k, l->element_c, l->body_c);
    const struct load_flows mid =
        load_flows(l, power_w, melt_w_k, l->element_c + 0.5 * dt_s * start.element_w / element_j_k,
                   l->body_c + 0.5 * dt_s * start.body_w / body_j_k);
    l->element_c += dt_s * mid.element_w / element_j_k;
    l->body_c += dt_s * mid.body_w / body_j_k;
    const double seen_c = v->ambient_c + v->sensor_gain * (l->body_c - v->ambient_c);
    l->sensor_c = seen_c + (l->sensor_c - seen_c) * exp(-dt_s / v->sensor_tau_s);
    l->heater_j += power_w * dt_s;
    l->lost_j += mid.to_air_w * dt_s;
    l->melt_j += mid.melt_w * dt_s;
}

void thermal_load_advance(struct thermal_load *l, double dt_s)
{
    if (!(dt_s > 0))
        return;
    const double conductance =
        l->v.link_w_k + l->v.loss_factor * (l->v.loss_w_k + l->v.element_loss_w_k) + l->v.fan_w_k + l->v.melt_ua_w_k;
    const double fastest_s = fmin(l->v.element_j_k, l->v.body_j_k) * l->v.mass_factor / conductance;
    const double max_step_s = fmin(0.1 * fmin(fastest_s, 1.0), 0.05);
    const double steps = ceil(dt_s / max_step_s);
    for (double i = 0; i < steps; i++)
        load_step(l, dt_s / steps);
}

static double divider_code(const struct thermal_load *l)
{
    if (fault_is(l, THERMAL_LOAD_SENSOR_OPEN))
        return l->v.adc_max;
    if (fault_is(l, THERMAL_LOAD_SENSOR_SHORT))
        return 0;
    const double thermistor_ohm =
        l->v.thermistor_r25_ohm * exp(l->v.thermistor_beta_k * (1 / (l->sensor_c + kelvin) - 1 / reference_k));
    const double to_ground_ohm = thermistor_ohm + l->v.inline_ohm;
    return l->v.adc_max * to_ground_ohm / (to_ground_ohm + l->v.pullup_ohm);
}

void thermal_load_sample(struct thermal_load *l, uint16_t *out, uint32_t n)
{
    const double level = divider_code(l);
    for (uint32_t done = 0; done < n;) {
        const struct noise_rows rows = noise_run(&l->noise);
        for (int i = 0; i < NOISE_RUN && done < n; i++, done++) {
            const double code =
                floor(level + l->v.noise_lsb * (double)(rows.sign[i] * (rows.a[i] + rows.b[i])) + 0.5);
            out[done] = (uint16_t)fmin(fmax(code, 0), l->v.adc_max);
        }
    }
}

void thermal_load_read(const struct thermal_load *l, struct thermal_load_outputs *out)
{
    const double mc_w_k = 1e-3 * l->v.melt_heat_mj_m3k * l->flow;
    const double share = mc_w_k <= 1e-12 ? 1 : melt_conductance(l) / mc_w_k;
    *out = (struct thermal_load_outputs){
        .body_c = l->body_c,
        .sensor_c = l->sensor_c,
        .element_c = l->element_c,
        .melt_c = l->flow > 1e-6 ? l->v.melt_in_c + share * (l->body_c - l->v.melt_in_c) : l->body_c,
        .power_w = heater_power(l),
        .flow_mm3_s = l->flow,
    };
}
