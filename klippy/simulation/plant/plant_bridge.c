// Tables of the bridge and of the coil: bridge_table.h, made by scripts/bench/bridge_circuit.py.
//
// No equation here is one of plant_tank.c or of a sensing law. The circuit is test/data/bridge_circuit.cir: half bridges
// with dead time, output capacitance and diodes on the tank, simulated in time. Its results are in
// test/data/bridge_circuit.csv. Between the points of a table runs a cubic (Catmull-Rom); beyond its ends, a line (below
// the smallest drive, its value).
#include "plant_bridge.h"

#include <math.h>

#include "bridge_table.h"

// Place u on a grid of n points, as the first of two points and the share to the second; beyond the ends it is < 0 or > 1.
static int grid_place(double u, int n, double *share)
{
    const int low = u >= n - 1 ? n - 2 : u > 0 ? (int)u : 0;
    *share = u - low;
    return low;
}

static double cubic(const double *y, int n, double u)
{
    double s;
    const int i = grid_place(u, n, &s);
    const double a = y[i], b = y[i + 1];
    if (s < 0 || s > 1)
        return a + s * (b - a);
    const double before = i > 0 ? y[i - 1] : 2 * a - b, after = i + 2 < n ? y[i + 2] : 2 * b - a;
    return a + 0.5 * s * (b - before + s * (2 * before - 5 * a + 4 * b - after + s * (3 * (a - b) + after - before)));
}

// Cubic over the drive, at the four temperatures around steel_c, and over those.
static double over_drive_and_temperature(const double table[BRIDGE_TEMPS][BRIDGE_DRIVES], double drive_u, double temp_u)
{
    double column[BRIDGE_TEMPS];
    for (int i = 0; i < BRIDGE_TEMPS; i++)
        column[i] = cubic(table[i], BRIDGE_DRIVES, drive_u);
    return cubic(column, BRIDGE_TEMPS, temp_u);
}

struct bridge_shift bridge_dead_time(double dead_ns, double phase_ticks, double steel_c, double supply)
{
    const double log_supply = log(fmin(fmax(supply, 0.9), 1.1)); // the table has 0.95, 1 and 1.05
    const double drive_u = fmax(phase_ticks / bridge_drive_step_ticks - 1, 0);
    const double temp_u = (steel_c - bridge_temp_low_c) / bridge_temp_step_k;
    // Between 0 (no effect) and the dead times of the table, a line.
    int upper = 0;
    while (upper < BRIDGE_DEADS - 2 && dead_ns > bridge_dead_ns[upper + 1])
        upper++;
    const double span_ns = bridge_dead_ns[upper + 1] - bridge_dead_ns[upper];
    const double share = (dead_ns - bridge_dead_ns[upper]) / span_ns;
    struct bridge_shift out = {0, 0};
    for (int end = 0; end < 2; end++) {
        const int row = upper + end - 1;
        const double weight = end ? share : 1 - share;
        if (row < 0)
            continue;
        out.psi_deg += weight * over_drive_and_temperature(bridge_psi_deg[row], drive_u, temp_u);
        out.psi_deg += weight * log_supply *
                       over_drive_and_temperature(bridge_psi_deg_per_supply[row], drive_u, temp_u);
        out.log_current += weight * over_drive_and_temperature(bridge_log_current[row], drive_u, temp_u);
    }
    return out;
}

double coil_saturation_at(double x)
{
    const int points = sizeof(coil_saturation) / sizeof(*coil_saturation);
    return fmax(cubic(coil_saturation, points, 10 * x), 0);
}

double coil_resistance_at(double steel_c, double x)
{
    double column[BRIDGE_TEMPS];
    for (int i = 0; i < BRIDGE_TEMPS; i++)
        column[i] = cubic(coil_resistance[i], 5, 4 * x);
    return cubic(column, BRIDGE_TEMPS, (steel_c - bridge_temp_low_c) / bridge_temp_step_k);
}
