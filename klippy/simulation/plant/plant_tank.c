// The LCL tank as a phasor, and the signal a limiter makes of its current's phase.
//
//   V   = (4/pi) Vdc sin(phi/2)                       first harmonic of the bridge, phi = pi ticks / 45000
//   L1  = l1 [1 - slope S (T - Tref)],  S = exp(-0.457 x^2 - 0.599 x^8),  x = |I1| / Isat
//   D   = R (1 - w^2 L2 C1) + j w (L1 + L2 - w^2 L1 L2 C1),   I1 = V / D
//         + Rs (1 - w^2 L1 C1 + j w R C1) with switches of Rs
//   psi = arg(-I1),   error = gain (psi + 360 deg f skew) + offset exp(-decay p),   p = (ticks/45000)^2
//
// The steel saturates: L1 depends on |I1|, found by six rounds of putting |I1| back in (each shrinks the error by more
// than 4 at every power). Fitted to Table 1 of Oskolkov 2021 (3 units rms) and compared with ngspice and a switched bridge:
// I1 within 0.17 %, psi within 0.09 degrees, third harmonic at most 0.43 %.
//
// After a step the complex current and the offset settle from the old steady state to the new one with tau (27 us, 3.2
// bridge periods): amplitude and phase move together, so a small old current is soon forgotten and a large one is not.
//
// On top, where a parameter asks for it (plant_bridge.c): S by a table, a curve in L1(T), R by a table over temperature
// and current, and the turn and loss of the current by the bridge's dead time.
//
// The signal is limited, hence independent of the current's size, until the current is too small for the limiter
// (limiter_a): without drive the output falls to error 0. Signal model 1 is Table 1's direct law instead of psi:
//   error = a T exp(-b p) + c + d p + gain 360 deg f skew.
#include "plant_tank.h"

#include <math.h>

#include "plant.h"
#include "plant_bridge.h"

#define GRID_STEP_C 0.5 // steady states are solved on this grid; between, a line (curvature there: < 1e-4 units)
static const double pi = 3.14159265358979323846, phase_full_ticks = 45000.0;

void tank_init(struct tank *t)
{
    *t = (struct tank){.drive = {.frequency_hz = 120e3, .l1_factor = 1}};
}

void tank_changed(struct tank *t)
{
    t->cached = 0;
}

// L1 with the nozzle in it, at coil current x (of l1_saturation_a).
static double coil_h(const struct tank_drive *d, const struct plant_values *v, double skin_c, double x)
{
    const double x2 = x * x, x8 = x2 * x2 * x2 * x2;
    double saturation = exp(-0.457 * x2 - 0.599 * x8);
    if (v->saturation_table > 0)
        saturation += v->saturation_table * (coil_saturation_at(x) - saturation);
    double fall = v->l1_slope_per_k * saturation * (skin_c - v->l1_reference_c);
    if (v->l1_curve != 0) {
        const double u = (skin_c - 25) / 640, u2 = u * u;
        fall += v->l1_curve * saturation * u2 * (u2 - 0.35);
    }
    return (v->l1_uh * (1 - fall) * d->l1_factor + d->l1_add_uh) * 1e-6;
}

static double tank_ohm(const struct tank_drive *d, const struct plant_values *v, double skin_c, double x)
{
    const double rise = v->r_rise_per_k > 0 ? v->r_rise_per_k / 3e-4 * coil_resistance_at(skin_c, x) : 0;
    return v->r_ohm * (1 + rise) + d->r_add_ohm;
}

static void turn_current(struct tank_point *p, struct bridge_shift shift)
{
    const double size = exp(shift.log_current), angle = shift.psi_deg * (pi / 180), re = p->i_re;
    p->i_re = size * (cos(angle) * re - sin(angle) * p->i_im);
    p->i_im = size * (sin(angle) * re + cos(angle) * p->i_im);
}

static struct tank_point solve(const struct tank_drive *d, const struct plant_values *v, double skin_c)
{
    struct tank_point out = {0, 0, 0};
    const double share = d->phase_ticks / phase_full_ticks, p = share * share;
    const int direct_law = v->signal_model >= 0.5 && !d->empty;
    out.offset = direct_law ? v->law_slope * skin_c * exp(-v->law_decay * p) + v->law_zero + v->law_power * p
                            : v->offset_units * exp(-v->offset_decay * p);
    out.offset += d->signal_error;
    const double volt = d->open ? 0 : 4 / pi * d->supply_v * sin(0.5 * pi * share);
    if (volt <= 0)
        return out;
    const double w = 2 * pi * d->frequency_hz, l2 = d->l2_uh * 1e-6, c1 = d->c1_uf * 1e-6;
    const double w2l2c1 = w * w * l2 * c1;
    double re = 0, im = w * l2, current = 0;
    for (int round = 0; round < 6; round++) {
        const double x = current / v->l1_saturation_a;
        const double l1 = d->empty ? v->empty_l1_uh * 1e-6 : coil_h(d, v, skin_c, x);
        const double ohm = d->empty ? v->empty_r_ohm : tank_ohm(d, v, skin_c, x);
        re = ohm * (1 - w2l2c1) + v->switch_ohm * (1 - w * w * l1 * c1);
        im = w * (l2 + l1 * (1 - w2l2c1)) + v->switch_ohm * w * ohm * c1;
        current = volt / sqrt(re * re + im * im);
    }
    const double inverse = volt / (re * re + im * im);
    out.i_re = re * inverse;
    out.i_im = -im * inverse;
    if (v->dead_time_ns > 0)
        turn_current(&out, bridge_dead_time(v->dead_time_ns, d->phase_ticks, skin_c, d->supply_v / v->supply_nominal_v));
    return out;
}

static struct tank_point blend(struct tank_point a, struct tank_point b, double share)
{
    return (struct tank_point){a.i_re + share * (b.i_re - a.i_re), a.i_im + share * (b.i_im - a.i_im),
                               a.offset + share * (b.offset - a.offset)};
}

// Have the two grid points around skin_c ready; returns where between them it lies, 0..1.
static double enter_grid(struct tank *t, const struct plant_values *v, double skin_c)
{
    const double share = (skin_c - t->grid_low_c) / GRID_STEP_C;
    if (t->cached && share >= 0 && share < 1)
        return share;
    t->grid_low_c = floor(skin_c / GRID_STEP_C) * GRID_STEP_C;
    t->low = solve(&t->drive, v, t->grid_low_c);
    t->high = solve(&t->drive, v, t->grid_low_c + GRID_STEP_C);
    t->low_error = tank_error(t, v, t->low);
    t->high_error = tank_error(t, v, t->high);
    t->cached = 1;
    return (skin_c - t->grid_low_c) / GRID_STEP_C;
}

struct tank_point tank_steady(struct tank *t, const struct plant_values *v, double skin_c)
{
    const double share = enter_grid(t, v, skin_c);
    return blend(t->low, t->high, share);
}

double tank_steady_error(struct tank *t, const struct plant_values *v, double skin_c)
{
    const double share = enter_grid(t, v, skin_c);
    return t->low_error + share * (t->high_error - t->low_error);
}

struct tank_point tank_now(const struct tank *t, struct tank_point steady)
{
    return blend(steady, t->from, t->unsettled);
}

void tank_set_drive(struct tank *t, const struct plant_values *v, const struct tank_drive *d, double skin_c)
{
    t->from = tank_now(t, tank_steady(t, v, skin_c));
    t->unsettled = 1;
    t->drive = *d;
    t->cached = 0;
}

double tank_error(const struct tank *t, const struct plant_values *v, struct tank_point p)
{
    const double current = sqrt(p.i_re * p.i_re + p.i_im * p.i_im);
    double error = p.offset + v->gain_units_deg * 360 * t->drive.frequency_hz * t->drive.late_ns * 1e-9;
    if (v->signal_model < 0.5 || t->drive.empty)
        error += v->gain_units_deg * atan2(-p.i_im, -p.i_re) * (180 / pi);
    return current > 20 * v->limiter_a ? error : error * tanh(current / v->limiter_a);
}
