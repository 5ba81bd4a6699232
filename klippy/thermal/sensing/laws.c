// The three sensing laws in closed form. See laws.h.

#include "laws.h"
#include <math.h>

#define FORWARD_ROUNDS 30 // fixed point of the tank law forwards: each shrinks the error by more than 4
#define FORWARD_ENOUGH_RAD 1e-13
#define PSI_MAX_RAD 1.35 // 77 degrees: beyond, the tangent magnifies noise twenty times

// Coefficients by name.
enum { EXP_A, EXP_B, EXP_C, EXP_D };
enum { EQ5_A, EQ5_B, EQ5_AB, EQ5_BB, EQ5_ABB, EQ5_C };
enum { TANK_G, TANK_T0, TANK_W, TANK_DELTA, TANK_B, TANK_Q, TANK_C, TANK_D, TANK_M };

static const struct sensing_reading no_reading = {NAN, NAN, 0.0};

// p: share of the full phase, squared.
static double
power_share(const struct sensing_law *law, double phase_ticks)
{
    double ratio = phase_ticks / law->phase_max_ticks;
    return ratio * ratio;
}

// --- exp and eq5: straight lines error = offset + slope T at each phase ---

struct line {
    double offset, slope;
};

static struct line
line_at(const struct sensing_law *law, double phase_ticks, double supply)
{
    const double *k = law->k;
    if (law->kind == SENSING_EXP) {
        double p = power_share(law, phase_ticks);
        return (struct line){k[EXP_C] + k[EXP_D] * p, k[EXP_A] * exp(-k[EXP_B] * p * supply * supply)};
    }
    double i = phase_ticks, field = phase_ticks * supply;
    return (struct line){k[EQ5_C] + (k[EQ5_B] + k[EQ5_BB] * i) * i,
                         k[EQ5_A] + (k[EQ5_AB] + k[EQ5_ABB] * field) * field};
}

// --- tank ---

static double
tank_offset(const struct sensing_law *law, double phase_ticks)
{
    const double *k = law->k;
    return k[TANK_C] + k[TANK_D] * exp(-k[TANK_M] * power_share(law, phase_ticks));
}

// (s V/V0)^2: the coil's field, but for the current's phase.
static double
tank_field(const struct sensing_law *law, double phase_ticks, double supply)
{
    double amplitude = sin(0.5 * M_PI * phase_ticks / law->phase_max_ticks) * supply;
    return amplitude * amplitude;
}

// -ln S
static double
tank_saturation(const struct sensing_law *law, double u)
{
    return u * (law->k[TANK_B] + law->k[TANK_Q] * u * u * u);
}

static double
tank_angle(const struct sensing_law *law, double error, double phase_ticks)
{
    return (error - tank_offset(law, phase_ticks)) / law->k[TANK_G];
}

static double
tank_error(const struct sensing_law *law, double temp_c, double phase_ticks, double supply)
{
    const double *k = law->k;
    double field = tank_field(law, phase_ticks, supply), psi = 0.0;
    for (int round = 0; round < FORWARD_ROUNDS; round++) {
        double cosine = cos(psi), before = psi;
        double share = exp(-tank_saturation(law, field * cosine * cosine));
        psi = atan(((temp_c - k[TANK_T0]) * share + k[TANK_DELTA]) / k[TANK_W]);
        if (fabs(psi - before) < FORWARD_ENOUGH_RAD)
            break;
    }
    return k[TANK_G] * psi + tank_offset(law, phase_ticks);
}

static struct sensing_reading
tank_invert(const struct sensing_law *law, double error, double phase_ticks, double supply)
{
    const double *k = law->k;
    double psi = tank_angle(law, error, phase_ticks);
    if (!(-PSI_MAX_RAD < psi && psi < PSI_MAX_RAD))
        return no_reading;
    double tangent = tan(psi), cosine = cos(psi);
    double u = tank_field(law, phase_ticks, supply) * cosine * cosine;
    double growth = exp(tank_saturation(law, u));
    double reach = k[TANK_W] * tangent - k[TANK_DELTA];
    // d(-ln S)/dpsi = (b + 4 q u^3) du/dpsi, du/dpsi = -2 u tan(psi)
    double bend = (k[TANK_B] + 4.0 * k[TANK_Q] * u * u * u) * 2.0 * u * tangent;
    double slope = growth * (k[TANK_W] / (cosine * cosine) - reach * bend) / k[TANK_G];
    return slope > 0.0 ? (struct sensing_reading){k[TANK_T0] + reach * growth, slope, 0.0} : no_reading;
}

// --- the table beside the tank law ---

// Place among ascending points: index below, and the share of the way to the next; clamped.
struct place {
    int below;
    double share;
};

static struct place
place_in(const double *points, int count, double at)
{
    int below = 0;
    while (below + 2 < count && at >= points[below + 1])
        below++;
    double share = (at - points[below]) / (points[below + 1] - points[below]);
    return (struct place){below, fmin(1.0, fmax(0.0, share))};
}

static double
added_at(const struct sensing_law *law, struct place level, int node)
{
    const double *low = law->added_c[level.below], *high = law->added_c[level.below + 1];
    return low[node] + level.share * (high[node] - low[node]);
}

// The law's temperature from that of the tank.
static struct sensing_reading
with_table(const struct sensing_law *law, struct sensing_reading tank, double phase_ticks)
{
    if (!law->levels || isnan(tank.temp_c))
        return tank;
    struct place level = place_in(law->level_ticks, law->levels, phase_ticks);
    struct place at = place_in(law->node_c, law->nodes, tank.temp_c);
    double low_c = added_at(law, level, at.below), rise_c = added_at(law, level, at.below + 1) - low_c;
    double slope = rise_c / (law->node_c[at.below + 1] - law->node_c[at.below]);
    int outside = tank.temp_c < law->node_c[0] || tank.temp_c > law->node_c[law->nodes - 1];
    double c_per_unit = tank.c_per_unit * (outside ? 1.0 : 1.0 + slope);
    const double *error_c = law->error_c + level.below;
    return (struct sensing_reading){tank.temp_c + low_c + at.share * rise_c, c_per_unit,
                                    error_c[0] + level.share * (error_c[1] - error_c[0])};
}

// The reverse; the fit keeps it unique.
static double
without_table(const struct sensing_law *law, double temp_c, double phase_ticks)
{
    if (!law->levels)
        return temp_c;
    struct place level = place_in(law->level_ticks, law->levels, phase_ticks);
    double low_c = law->node_c[0] + added_at(law, level, 0);
    if (temp_c <= low_c)
        return law->node_c[0] + temp_c - low_c;
    for (int node = 1; node < law->nodes; node++) {
        double high_c = law->node_c[node] + added_at(law, level, node);
        if (temp_c <= high_c) {
            double share = (temp_c - low_c) / (high_c - low_c);
            return law->node_c[node - 1] + share * (law->node_c[node] - law->node_c[node - 1]);
        }
        low_c = high_c;
    }
    return law->node_c[law->nodes - 1] + temp_c - low_c;
}

// --- all of them ---

double
sensing_error(const struct sensing_law *law, double temp_c, double phase_ticks, double supply)
{
    if (law->kind == SENSING_TANK)
        return tank_error(law, without_table(law, temp_c, phase_ticks), phase_ticks, supply);
    struct line at = line_at(law, phase_ticks, supply);
    return at.offset + at.slope * temp_c;
}

struct sensing_reading
sensing_invert(const struct sensing_law *law, double error, double phase_ticks, double supply)
{
    if (law->kind == SENSING_TANK)
        return with_table(law, tank_invert(law, error, phase_ticks, supply), phase_ticks);
    struct line at = line_at(law, phase_ticks, supply);
    return at.slope > 0.0 ? (struct sensing_reading){(error - at.offset) / at.slope, 1.0 / at.slope, 0.0}
                          : no_reading;
}

double
sensing_rezeroed(const struct sensing_law *law, double temp_c, double error, double phase_ticks, double supply)
{
    const double *k = law->k;
    if (law->kind != SENSING_TANK) {
        double c = k[law->kind == SENSING_EXP ? EXP_C : EQ5_C];
        return c + error - sensing_error(law, temp_c, phase_ticks, supply);
    }
    double psi = tank_angle(law, error, phase_ticks), cosine = cos(psi);
    double share = exp(-tank_saturation(law, tank_field(law, phase_ticks, supply) * cosine * cosine));
    return k[TANK_W] * tan(psi) - (without_table(law, temp_c, phase_ticks) - k[TANK_T0]) * share;
}
