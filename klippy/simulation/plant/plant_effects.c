// Supply, parts, wall, tip, movement and disturbances of a real machine.
//
//   supply   dVb/dt = (V - Rs I - Vb) / (Rs Cbus)                              bus behind the supply's resistance
//            dVb/dt = -(P Vb^2/Vnom^2) / (Cbus Vb)                             with its switch open
//   parts    C dT/dt = I^2 R - g (T - air)                                     coil (with copper's R), C1, L2
//            i(C1) = w^2 L1 C1 i(L1),  i(L2) = |1 - w^2 L1 C1| i(L1)
//   values   C1, L2: (1 + a (T - 25)),  coil: R + Rcu b (T - 25), L1 (1 + c (T - 25))
//   wall     skin = mean + sum of k_n,  dk_n/dt = (K g_n P - k_n) n^2 pi^2 / s,  g_n = 6 / (pi n)^2
//            (diffusion in a slab heated on one side, K = w/3kA, s = w^2/alpha; the last mode holds what is left)
//            and K/2 times the heat into the melt, which crosses the wall
//   tip      tau dTt/dt = bore - Kt Q - Tt                                      Q: heat into the melt
//   place    L1 (1 + a um): sine, full steps of the motors, random; cable: nH with the head's place
//   signal   delay ns/K of the drivers, error of this machine: a sum of cosines over phase/45000
//   ADC      filtered noise; a sine and noise of some bandwidth about it
#include "plant_effects.h"

#include <math.h>

#include "plant.h"

static const double pi = 3.14159265358979323846, phase_full_ticks = 45000.0, values_hold_c = 25.0;
static const double rest_mode_n2 = 80; // of the modes above the last: 0.3 ms after a step within 3 % of the slab's answer

void effects_changed(struct plant *p)
{
    const struct plant_values *v = &p->v;
    struct plant_effects *e = &p->effects;
    e->wall = v->wall_k_w > 0;
    e->tip = e->wall || v->tip_k_w > 0;
    e->parts = v->coil_j_k > 0 || v->cap_j_k > 0 || v->choke_j_k > 0;
    e->bus = v->bus_uf > 0;
    e->moves = v->cable_l1_nh != 0 || v->cable_l2_nh != 0 || v->move_um != 0 || v->move_step_um != 0 ||
               v->move_random_um != 0;
    e->live_power = v->curie_drop > 0 || v->dead_time_ns > 0 || e->bus;
    e->live_drive = v->ripple_v != 0 || e->bus || e->parts || e->moves;
    e->noisy = v->coloured_lsb != 0 || v->emi_lsb != 0 || v->emi_broad_lsb != 0;
    struct noise_source shape = {(uint64_t)v->machine_number};
    double squares = 0;
    for (int k = 0; k < LAW_ERROR_TERMS; k++) {
        e->law_error[k] = (double)(noise_bits(&shape) >> 11) / 9007199254740992.0 - 0.5;
        squares += e->law_error[k] * e->law_error[k];
    }
    for (int k = 0; k < LAW_ERROR_TERMS; k++) // cosines have an rms of sqrt(1/2)
        e->law_error[k] *= v->signal_error * sqrt(2 / squares);
}

void effects_init(struct plant *p, uint64_t seed)
{
    struct plant_effects *e = &p->effects;
    e->coil_c = p->v.ambient_c;
    e->cap_c = e->choke_c = p->v.board_c;
    e->bus_v = p->v.supply_v;
    noise_seed(&e->noise, ~seed);
    effects_changed(p);
}

// ---- in time -------------------------------------------------------------------------------------------------------

static double gauss(struct noise_source *n)
{
    const struct noise_rows row = noise_run(n);
    return *row.sign * (*row.a + *row.b);
}

// One step of noise with a bandwidth of hz and an rms of 1 (first order, exact).
static double filtered(struct plant_effects *e, double x, double hz, double dt_s)
{
    const double keep = exp(-2 * pi * hz * dt_s);
    return x * keep + sqrt(1 - keep * keep) * gauss(&e->noise);
}

static double warmed(double temp_c, double dt_s, double heat_w, double air_c, double loss_w_k, double j_k)
{
    const double end_c = air_c + heat_w / loss_w_k;
    return end_c + (temp_c - end_c) * exp(-dt_s * loss_w_k / j_k);
}

static void advance_parts(struct plant *p, double dt_s, double air_w)
{
    const struct plant_values *v = &p->v;
    struct plant_effects *e = &p->effects;
    const struct tank_point now = tank_steady(&p->tank, v, p->skin_c);
    const double mean_square = 0.5 * (now.i_re * now.i_re + now.i_im * now.i_im);
    const double w = 2 * pi * p->tank.drive.frequency_hz, lc = w * w * v->l1_uh * p->tank.drive.c1_uf * 1e-12;
    if (v->coil_j_k > 0) {
        const double copper_ohm = v->coil_ohm * (1 + v->coil_rise_per_k * (e->coil_c - values_hold_c));
        const double heat_w = mean_square * copper_ohm + v->coil_share * air_w;
        e->coil_c = warmed(e->coil_c, dt_s, heat_w, v->ambient_c, v->coil_w_k, v->coil_j_k);
    }
    if (v->cap_j_k > 0)
        e->cap_c = warmed(e->cap_c, dt_s, mean_square * lc * lc * v->cap_ohm, v->board_c, v->cap_w_k, v->cap_j_k);
    if (v->choke_j_k > 0)
        e->choke_c = warmed(e->choke_c, dt_s, mean_square * (1 - lc) * (1 - lc) * v->choke_ohm, v->board_c,
                            v->choke_w_k, v->choke_j_k);
}

// With the supply's switch open the bridge alone empties the bus: its power goes with the square of the voltage.
static double bus_tau_s(const struct plant *p)
{
    const struct plant_values *v = &p->v;
    const double bus_f = v->bus_uf * 1e-6;
    if (!p->supply_open)
        return fmax(v->supply_ohm * bus_f, 1e-9);
    return bus_f * v->supply_nominal_v * v->supply_nominal_v / fmax(plant_electrical_power(p, 0), 1e-3);
}

static double advance_wall(struct plant *p, double dt_s, double power_w)
{
    struct plant_effects *e = &p->effects;
    double excess_k = 0.5 * p->v.wall_k_w * p->melt_w, left = 1;
    for (int i = 0; i < WALL_MODES; i++) {
        const int last = i == WALL_MODES - 1;
        const double n2 = last ? rest_mode_n2 : (i + 1) * (i + 1), share = last ? left : 6 / (pi * pi * n2);
        const double end_k = p->v.wall_k_w * share * power_w;
        e->wall_k[i] = end_k + (e->wall_k[i] - end_k) * exp(-dt_s * n2 * pi * pi / p->v.wall_s);
        excess_k += e->wall_k[i];
        left -= share;
    }
    return excess_k;
}

void effects_advance(struct plant *p, double dt_s, double power_w, double air_w)
{
    const struct plant_values *v = &p->v;
    struct plant_effects *e = &p->effects;
    p->skin_c = p->mean_c;
    p->tip_c = p->bore_c;
    if (e->wall)
        p->skin_c += advance_wall(p, dt_s, power_w);
    if (e->tip) {
        e->tip_k = warmed(e->tip_k, dt_s, (v->wall_k_w + v->tip_k_w) * p->melt_w, 0, 1, v->tip_tau_s);
        p->tip_c -= e->tip_k;
    }
    if (e->bus) {
        const double end_v = plant_loaded_supply(p);
        e->bus_v = end_v + (e->bus_v - end_v) * exp(-dt_s / bus_tau_s(p));
    }
    if (e->parts)
        advance_parts(p, dt_s, air_w);
    if (v->move_random_um != 0)
        e->random_um = filtered(e, e->random_um, v->move_random_hz, dt_s);
}

// ---- what the tank and the ADC meet --------------------------------------------------------------------------------

static double place_um(const struct plant *p)
{
    const struct plant_values *v = &p->v;
    return v->move_um * sin(2 * pi * v->move_hz * p->time_s) +
           v->move_step_um * sin(2 * pi * p->effects.way_mm / v->move_step_mm) + v->move_random_um * p->effects.random_um;
}

void effects_drive(const struct plant *p, struct tank_drive *d)
{
    const struct plant_values *v = &p->v;
    const struct plant_effects *e = &p->effects;
    const double cap_c = v->cap_j_k > 0 ? e->cap_c : v->board_c, choke_c = v->choke_j_k > 0 ? e->choke_c : v->board_c;
    const double coil_k = v->coil_j_k > 0 ? e->coil_c - values_hold_c : 0;
    d->c1_uf = v->c1_uf * v->c1_factor * (1 + 1e-6 * v->c1_ppm_k * (cap_c - values_hold_c));
    d->l2_uh = v->l2_uh * (1 + 1e-6 * v->l2_ppm_k * (choke_c - values_hold_c)) + 1e-3 * v->cable_l2_nh * e->head;
    d->l1_factor = (1 - v->coil_short) * (1 - v->coil_short);
    d->l1_factor *= 1 + v->coil_expansion_per_k * coil_k + (e->moves ? 1e-6 * v->move_ppm_um * place_um(p) : 0);
    d->l1_add_uh = 1e-3 * v->cable_l1_nh * e->head;
    d->r_add_ohm = v->coil_ohm * v->coil_rise_per_k * coil_k;
    d->late_ns = p->moved_ns + v->skew_ns + v->delay_ns_k * (v->board_c - values_hold_c);
    if (plant_fault_is(p, PLANT_LEG_DEAD) && p->phase_ticks > 0) // the legs lie phi/2 before and behind the middle
        d->late_ns += 0.25e9 / d->frequency_hz * (p->phase_ticks / phase_full_ticks - 1);
    d->signal_error = 0;
    for (int k = 0; k < LAW_ERROR_TERMS && v->signal_error > 0; k++)
        d->signal_error += e->law_error[k] * cos((k + 1) * pi * d->phase_ticks / phase_full_ticks);
}

double effects_disturbance(struct plant *p, double t_s, double dt_s)
{
    const struct plant_values *v = &p->v;
    struct plant_effects *e = &p->effects;
    if (!e->noisy)
        return 0;
    e->coloured = filtered(e, e->coloured, v->coloured_hz, dt_s);
    e->emi_in_phase = filtered(e, e->emi_in_phase, v->emi_broad_hz, dt_s);
    e->emi_quadrature = filtered(e, e->emi_quadrature, v->emi_broad_hz, dt_s);
    const double turn = 2 * pi * v->emi_hz * t_s;
    return v->coloured_lsb * e->coloured + (v->emi_lsb + v->emi_broad_lsb * e->emi_in_phase) * sin(turn) +
           v->emi_broad_lsb * e->emi_quadrature * cos(turn);
}

double effects_bus_code(struct plant *p, double full_scale_v)
{
    const double noise = p->v.vdc_noise_lsb > 0 ? p->v.vdc_noise_lsb / p->v.adc_max * gauss(&p->effects.noise) : 0;
    return plant_supply(p) * p->v.vdc_gain / full_scale_v + noise;
}
