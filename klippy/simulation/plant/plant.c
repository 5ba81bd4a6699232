// The simulated induction nozzle: thermal model, drive law and ADC. The tank is in plant_tank.c.
//
// Heat, all temperatures in degC:
//   C(T) dT/dt   = P - k01 (T - T2) - (g0 + fan g_fan)(T - Ta) - sigma eA (Tk^4 - Ta,k^4) - Q      skin
//   C2 dT2/dt    = k01 (T - T2) - g1 (T2 - Ta)                                                     second mass
//   tau dTb/dt   = T - Tb                                                                          bore (no heat of its own)
//   Q            = mc (Tb - Tin) (1 - exp(-UA/mc)),  mc = rho c flow                               melt
//   flow         = fed share, but no more than the drive's force brings through the hole        passed_flow
//   melt outlet  = Tin + (Tb - Tin)(1 - exp(-UA/mc))
//   C(T)         = m cp (1 + s (T - 25))
//   P            = heat (sin(phi/2) Vdc/Vnom)^1.5,  phi = pi ticks/45000                           drive
//   Pel          = base + swing sin^2(phi/2) while the bridge runs, never less than P
//
// Parameters fitted once to Table 5 and the static losses of Oskolkov 2021 (plant_params.h has the origins).
// Solved with the midpoint rule for T and T2 (fastest time constant about 5 s, step 2 ms: error 1e-7 of a step) and
// exact exponentials for the bore and flow lags, so no parameter can make it unstable within the table's limits.
#include "plant.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "plant_bridge.h"

static const double pi = 3.14159265358979323846, phase_full_ticks = 45000.0;
static const double one_leg_ticks = 15000; // half the voltage of both: sin(phi/2) = 1/2
static const double force_at_hole_mm = 0.4, force_at_mm3_s = 5, force_at_c = 210; // where melt_force_n holds
static const double sigma_sb = 5.670374e-8, kelvin = 273.15, cp_reference_c = 25.0;
static const double max_step_s = 2e-3, emptying_step_s = 1e-4, unsampled_settled_s = 5e-3;
static const double decay_done = 1e-7; // below this the tank counts as settled (error < 1e-4 units)

const struct plant_param plant_params[] = {
#define PLANT_ROW(name, unit, reference, strong, real, lo, hi, doc) {#name, unit, doc, reference, strong, real, lo, hi},
    PLANT_PARAM_TABLE(PLANT_ROW)
#undef PLANT_ROW
};
const int plant_param_count = PLANT_PARAM_COUNT;

_Static_assert(sizeof(struct plant_values) == PLANT_PARAM_COUNT * sizeof(double), "values must be a plain array");

// ---- drive ---------------------------------------------------------------------------------------------------------

int plant_fault_is(const struct plant *p, enum plant_fault fault)
{
    return (int)(p->v.fault + 0.5) == (int)fault || ((unsigned)p->v.fault_set >> fault & 1u);
}

double plant_phase_in_force(const struct plant *p)
{
    const double ticks = plant_fault_is(p, PLANT_BRIDGE_STUCK) ? p->v.fault_phase_ticks : p->phase_ticks;
    return plant_fault_is(p, PLANT_LEG_DEAD) && ticks > 0 ? one_leg_ticks : ticks;
}

static double half_sine(const struct plant *p)
{
    return sin(0.5 * pi * plant_phase_in_force(p) / phase_full_ticks);
}

double plant_electrical_power(const struct plant *p, double metal_w)
{
    const double s = half_sine(p);
    if (s <= 0)
        return 0;
    if (plant_fault_is(p, PLANT_COIL_BROKEN))
        return p->v.electrical_base_w;
    return fmax(metal_w, p->v.electrical_base_w + p->v.electrical_swing_w * s * s);
}

double plant_loaded_supply(const struct plant *p)
{
    if (p->supply_open)
        return 0;
    const double sag_v = p->v.supply_ohm * plant_electrical_power(p, 0) / fmax(p->v.supply_v, 1.0);
    return fmax(p->v.supply_v - sag_v, 0.0);
}

// The ripple is added where an instant matters; it averages out of the heat.
static double mean_supply(const struct plant *p)
{
    if (plant_fault_is(p, PLANT_SUPPLY_SHORT))
        return 0;
    return p->effects.bus ? p->effects.bus_v : plant_loaded_supply(p);
}

double plant_supply(const struct plant *p)
{
    const double mean_v = mean_supply(p);
    const double ripple_v = mean_v <= 0 || p->v.ripple_v == 0 || p->supply_open ? 0 : p->v.ripple_v * sin(2 * pi * p->v.ripple_hz * p->time_s);
    return mean_v + ripple_v;
}

static double metal_power(const struct plant *p)
{
    if (plant_fault_is(p, PLANT_NO_NOZZLE) || plant_fault_is(p, PLANT_COIL_BROKEN))
        return 0;
    const double drive = half_sine(p) * mean_supply(p) / p->v.supply_nominal_v;
    double power = p->v.heat_w * p->v.efficiency_factor * (1 - p->v.coil_short) * pow(fmax(drive, 0.0), p->v.heat_exponent);
    if (p->v.curie_drop > 0)
        power *= 1 - p->v.curie_drop / (1 + exp((p->v.curie_c - p->skin_c) / p->v.curie_width_k));
    if (p->v.dead_time_ns > 0 && power > 0)
        power *= exp(p->v.heat_exponent *
                     bridge_dead_time(p->v.dead_time_ns, plant_phase_in_force(p), p->skin_c, 1).log_current);
    return power;
}

static struct tank_drive drive_now(const struct plant *p)
{
    struct tank_drive d = {
        .phase_ticks = plant_phase_in_force(p),
        .supply_v = plant_supply(p),
        .frequency_hz = (1 + 1e-6 * p->v.frequency_ppm) / p->period_s,
        .empty = plant_fault_is(p, PLANT_NO_NOZZLE),
        .open = plant_fault_is(p, PLANT_COIL_BROKEN),
    };
    effects_drive(p, &d);
    return d;
}

// The temperature the tank answers to.
static double sensed_c(const struct plant *p)
{
    return p->v.reading_factor == 1 ? p->skin_c : 25 + p->v.reading_factor * (p->skin_c - 25);
}

// Hand a step of the drive to the tank; it settles from where it is.
static void drive_stepped(struct plant *p)
{
    const struct tank_drive d = drive_now(p);
    p->drive_w = metal_power(p);
    tank_set_drive(&p->tank, &p->v, &d, sensed_c(p));
    p->unsampled_s = 0;
}

// ---- parameters, inputs, outputs -----------------------------------------------------------------------------------

void plant_init(struct plant *p, const double *values, uint64_t seed)
{
    memset(p, 0, sizeof(*p));
    memcpy(&p->v, values, sizeof(p->v));
    p->mean_c = p->skin_c = p->tip_c = p->second_c = p->bore_c = p->v.start_c;
    p->period_s = 1 / 120e3;
    p->last_code = (int)lround(p->v.adc_zero);
    p->last_level = (float)p->v.adc_zero;
    noise_seed(&p->noise, seed);
    tank_init(&p->tank);
    effects_init(p, seed);
    drive_stepped(p);
    p->tank.unsettled = 0;
}

struct plant *plant_new(void)
{
    return calloc(1, sizeof(struct plant));
}

void plant_free(struct plant *p)
{
    free(p);
}

int plant_param_index(const char *name)
{
    for (int i = 0; i < plant_param_count; i++)
        if (strcmp(plant_params[i].name, name) == 0)
            return i;
    return -1;
}

double plant_get_param(const struct plant *p, int index)
{
    double values[PLANT_PARAM_COUNT];
    memcpy(values, &p->v, sizeof(values));
    return index >= 0 && index < PLANT_PARAM_COUNT ? values[index] : NAN;
}

void plant_set_param(struct plant *p, int index, double value)
{
    if (index < 0 || index >= PLANT_PARAM_COUNT)
        return;
    // The tank keeps its present current (tank_now) while the parameter changes under it, as at a phase step.
    const struct tank_point present = tank_now(&p->tank, tank_steady(&p->tank, &p->v, sensed_c(p)));
    memcpy((char *)&p->v + (size_t)index * sizeof(double), &value, sizeof(value));
    tank_changed(&p->tank);
    effects_changed(p);
    drive_stepped(p);
    p->tank.from = present;
    p->lags.dt_s = 0;
}

void plant_set_phase(struct plant *p, double phase_ticks)
{
    phase_ticks = fmin(fmax(phase_ticks, 0.0), phase_full_ticks);
    if (phase_ticks == p->phase_ticks)
        return;
    p->phase_ticks = phase_ticks;
    if (!plant_fault_is(p, PLANT_BRIDGE_STUCK))
        drive_stepped(p);
}

void plant_set_supply(struct plant *p, int open)
{
    if (open == p->supply_open)
        return;
    p->supply_open = open;
    drive_stepped(p);
}

void plant_set_inputs(struct plant *p, double flow_mm3_s, double fan)
{
    p->flow_in = fmax(flow_mm3_s, 0.0); // retraction pulls no heat out
    p->fan = fmin(fmax(fan, 0.0), 1.0);
}

void plant_move_sampling(struct plant *p, double late_ns)
{
    p->tank.drive.late_ns += late_ns - p->moved_ns;
    p->moved_ns = late_ns;
    tank_changed(&p->tank);
}

void plant_set_head(struct plant *p, double place, double way_mm)
{
    p->effects.head = place;
    p->effects.way_mm = way_mm;
}

// Share of the way from entry to wall temperature that the melt goes.
static double melt_share(const struct plant *p)
{
    const double mc_w_k = 1e-3 * p->v.melt_heat_mj_m3k * p->flow; // MJ/m^3 x mm^3/s = 1e-3 W/K
    return mc_w_k <= 1e-12 ? 1 : -expm1(-p->v.melt_ua_w_k / mc_w_k);
}

void plant_read(const struct plant *p, struct plant_outputs *out)
{
    const double metal_w = metal_power(p);
    *out = (struct plant_outputs){
        .skin_c = p->skin_c,
        .mean_c = p->mean_c,
        .bore_c = p->bore_c - p->v.wall_k_w * p->melt_w,
        .tip_c = p->tip_c,
        .melt_c = p->flow > 1e-6 ? p->v.melt_in_c + (p->tip_c - p->v.melt_in_c) * melt_share(p) : p->tip_c,
        .second_c = p->second_c,
        .coil_c = p->effects.coil_c,
        .supply_v = plant_supply(p),
        .power_w = metal_w,
        .electrical_w = plant_electrical_power(p, metal_w),
        .flow_mm3_s = p->flow,
    };
}

// ---- thermal -------------------------------------------------------------------------------------------------------

static double wall_capacity(const struct plant_values *v, double mean_c)
{
    const double mass_kg = 1e-3 * v->mass_g * v->mass_factor;
    return mass_kg * v->cp_j_kgk * (1 + v->cp_slope_per_k * (mean_c - cp_reference_c));
}

struct heat_flows {
    double mean_net_w, second_net_w, to_air_w, nozzle_air_w;
};

static struct heat_flows heat_flows(const struct plant *p, double power_w, double mean_c, double second_c)
{
    const struct plant_values *v = &p->v;
    const double mean_k2 = (mean_c + kelvin) * (mean_c + kelvin);
    const double air_k2 = (v->ambient_c + kelvin) * (v->ambient_c + kelvin);
    const double link_w = v->loss_factor * v->link_w_k * (mean_c - second_c);
    const double second_air_w = v->loss_factor * v->second_loss_w_k * (second_c - v->ambient_c);
    const double nozzle_air_w =
        v->loss_factor * (v->loss_w_k * (mean_c - v->ambient_c) +
                          sigma_sb * v->radiation_area_m2 * (mean_k2 * mean_k2 - air_k2 * air_k2)) +
        p->fan * v->fan_w_k * (mean_c - v->ambient_c);
    return (struct heat_flows){power_w - link_w - nozzle_air_w - p->melt_w, link_w - second_air_w,
                               nozzle_air_w + second_air_w, nozzle_air_w};
}

// Against the filament at a flow of force_at_mm3_s, N.
static double force_at_flow(const struct plant *p)
{
    const struct plant_values *v = &p->v;
    const double thin = exp(v->force_arrhenius_k * (1 / (p->bore_c + kelvin) - 1 / (force_at_c + kelvin)));
    return v->melt_force_n * thin * pow(force_at_hole_mm / v->hole_mm, v->force_hole_exponent);
}

// Flow that the drive brings through the hole. Power law of the melt: where the force would be more, the drive slips.
static double passed_flow(const struct plant *p)
{
    const struct plant_values *v = &p->v;
    const double fed = p->flow_in * v->flow_share;
    if (v->hole_mm <= 0)
        return 0;
    if (v->drive_force_n <= 0 || v->melt_force_n <= 0 || fed <= 0)
        return fed;
    return fmin(fed, force_at_mm3_s * pow(v->drive_force_n / force_at_flow(p), 1 / v->force_flow_exponent));
}

double plant_back_force(const struct plant *p)
{
    const struct plant_values *v = &p->v;
    if (p->flow_in * v->flow_share <= 0)
        return 0;
    if (v->hole_mm <= 0)
        return v->drive_force_n;
    const double force_n = force_at_flow(p) * pow(p->flow / force_at_mm3_s, v->force_flow_exponent);
    return v->drive_force_n > 0 ? fmin(force_n, v->drive_force_n) : force_n;
}

static void update_lags(struct plant *p, double dt_s)
{
    if (p->lags.dt_s == dt_s)
        return;
    p->lags.dt_s = dt_s;
    p->lags.bore = exp(-dt_s / p->v.bore_tau_s);
    p->lags.flow = p->v.flow_tau_s > 0 ? exp(-dt_s / p->v.flow_tau_s) : 0;
}

static void thermal_step(struct plant *p, double dt_s)
{
    update_lags(p, dt_s);
    const double passed = passed_flow(p);
    p->flow = passed + (p->flow - passed) * p->lags.flow;
    if (p->flow < 1e-9)
        p->flow = 0;
    p->melt_w =
        p->flow > 0 ? 1e-3 * p->v.melt_heat_mj_m3k * p->flow * (p->tip_c - p->v.melt_in_c) * melt_share(p) : 0;
    const double power_w = p->effects.live_power ? metal_power(p) : p->drive_w;
    const struct heat_flows start = heat_flows(p, power_w, p->mean_c, p->second_c);
    const double mid_mean_c = p->mean_c + 0.5 * dt_s * start.mean_net_w / wall_capacity(&p->v, p->mean_c);
    const double mid_second_c = p->second_c + 0.5 * dt_s * start.second_net_w / p->v.second_j_k;
    const struct heat_flows mid = heat_flows(p, power_w, mid_mean_c, mid_second_c);
    const double rise_c = dt_s * mid.mean_net_w / wall_capacity(&p->v, mid_mean_c);
    // Exact for a wall that moves along a straight line during the step.
    const double lag_share = 1 - p->lags.bore;
    p->bore_c += (p->mean_c - p->bore_c) * lag_share + rise_c * (1 - lag_share * p->v.bore_tau_s / dt_s);
    p->mean_c += rise_c;
    p->second_c += dt_s * mid.second_net_w / p->v.second_j_k;
    effects_advance(p, dt_s, power_w, mid.nozzle_air_w);
    p->metal_j += power_w * dt_s;
    p->lost_j += mid.to_air_w * dt_s;
    p->melt_j += p->melt_w * dt_s;
    p->time_s += dt_s;
}

void plant_advance(struct plant *p, double dt_s)
{
    if (!(dt_s > 0))
        return;
    p->unsampled_s += dt_s;
    const double longest_s = p->supply_open && p->effects.bus_v > 0.1 ? emptying_step_s : max_step_s;
    while (dt_s > longest_s) {
        thermal_step(p, longest_s);
        dt_s -= longest_s;
    }
    thermal_step(p, dt_s);
}

// Heat stored in nozzle and second mass above start_c.
static double stored_heat(const struct plant *p)
{
    const struct plant_values *v = &p->v;
    const double from_c = v->start_c - cp_reference_c, to_c = p->mean_c - cp_reference_c;
    const double flat_j_k = wall_capacity(v, cp_reference_c);
    return flat_j_k * (to_c - from_c + 0.5 * v->cp_slope_per_k * (to_c * to_c - from_c * from_c)) +
           v->second_j_k * (p->second_c - v->start_c);
}

void plant_energy(const struct plant *p, struct plant_balance *out)
{
    *out = (struct plant_balance){p->metal_j, p->lost_j, p->melt_j, stored_heat(p)};
}

// ---- ADC -----------------------------------------------------------------------------------------------------------

// n codes around one level. Blocks of 16 with a constant count: gcc and clang make vector code of that at -O2. Reads
// up to 15 entries of the rows past n, which they have room for.
static void quantise(uint16_t *restrict out, uint32_t n, struct noise_rows rows, float level, float sigma, float top)
{
    const float *restrict a = rows.a, *restrict b = rows.b, *restrict sign = rows.sign;
    uint16_t block[16];
    while (n) {
        const uint32_t take = n < 16 ? n : 16;
        for (int i = 0; i < 16; i++) {
            float x = level + sigma * sign[i] * (a[i] + b[i]);
            x = x > 0 ? x : 0;
            x = x < top ? x : top;
            block[i] = (uint16_t)(int32_t)(x + 0.5f); // positive: truncation of x + 1/2 rounds to nearest
        }
        memcpy(out, block, take * sizeof(*out));
        out += take, a += 16, b += 16, sign += 16, n -= take;
    }
}

// In codes, before white noise.
static float level_of(struct plant *p, double error, double disturbance_lsb)
{
    const double signal = (plant_fault_is(p, PLANT_SIGNAL_LOST) ? 0 : error) / p->v.units_per_lsb;
    if (!plant_fault_is(p, PLANT_SIGNAL_HELD))
        p->last_level = (float)(p->v.adc_zero + p->v.sense_gain * signal + disturbance_lsb);
    return plant_fault_is(p, PLANT_SENSE_SHORT) ? 0 : p->last_level + (float)p->v.sense_offset_lsb;
}

// Where the drive moves without a step; everything else went through drive_stepped.
static void follow_drive(struct plant *p, double period_s)
{
    if (!p->effects.live_drive && period_s == p->period_s)
        return;
    p->period_s = period_s;
    p->tank.drive = drive_now(p);
    tank_changed(&p->tank);
}

static void sample_run(struct plant *p, uint16_t *out, uint32_t n, double decay_per_sample, double disturbance_lsb)
{
    const float sigma = (float)(plant_fault_is(p, PLANT_SIGNAL_HELD) ? p->v.fault_noise_lsb : p->v.noise_lsb), top = (float)p->v.adc_max;
    struct noise_rows rows = noise_run(&p->noise);
    uint32_t done = 0;
    for (; done < n && p->tank.unsettled > 0; done++) {
        const struct tank_point now = tank_now(&p->tank, tank_steady(&p->tank, &p->v, sensed_c(p)));
        const float level = level_of(p, tank_error(&p->tank, &p->v, now), disturbance_lsb);
        quantise(out + done, 1, rows, level, sigma, top);
        rows.a++, rows.b++, rows.sign++;
        p->tank.unsettled *= decay_per_sample;
        if (p->tank.unsettled < decay_done)
            p->tank.unsettled = 0;
    }
    if (done == n)
        return;
    const float level = level_of(p, tank_steady_error(&p->tank, &p->v, sensed_c(p)), disturbance_lsb);
    quantise(out + done, n - done, rows, level, sigma, top);
}

void plant_sample(struct plant *p, uint16_t *out, uint32_t n, double period_s)
{
    if (!n)
        return;
    if (p->unsampled_s > unsampled_settled_s)
        p->tank.unsettled = 0;
    p->unsampled_s = 0;
    follow_drive(p, period_s);
    const double decay_per_sample = p->tank.unsettled > 0 ? exp(-period_s * 1e6 / p->v.tank_tau_us) : 0;
    const uint32_t longest = p->effects.noisy ? 16 : NOISE_RUN - 16; // 7.5 kHz for disturbances up to 3 kHz
    for (uint32_t done = 0; done < n;) {
        const uint32_t take = n - done < longest ? n - done : longest;
        const double disturbance_lsb = effects_disturbance(p, p->time_s + done * period_s, take * period_s);
        sample_run(p, out + done, take, decay_per_sample, disturbance_lsb);
        done += take;
    }
    if (plant_fault_is(p, PLANT_SIGNAL_STUCK)) {
        const int code = p->v.fault_code < 0 ? p->last_code : (int)lround(p->v.fault_code);
        for (uint32_t i = 0; i < n; i++)
            out[i] = (uint16_t)code;
    }
    if (p->v.adc_set_bits > 0 || p->v.adc_clear_bits > 0)
        for (uint32_t i = 0; i < n; i++)
            out[i] = (uint16_t)((out[i] | (unsigned)p->v.adc_set_bits) & ~(unsigned)p->v.adc_clear_bits);
    p->last_code = out[n - 1];
}
