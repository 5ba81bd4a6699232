// Upper bounds y = c/f - t_sent and lower bounds y = c/f - t_received of a clock's line. Their hulls face each other; the
// strip leans on them where they come closest. Equations: klippy/link/clockfit.py.

#include "clockfit.h"

#include <math.h>

struct corner {
    double x, y;
};

// The corners that a string pulled tight below the points (in order of x) would touch.
static int lower_hull(const struct corner *points, int count, double sign, struct corner *hull)
{
    int n = 0;
    for (int i = 0; i < count; i++) {
        const struct corner p = {points[i].x, sign * points[i].y};
        for (; n > 1; n--) {
            const struct corner a = hull[n - 2], b = hull[n - 1];
            if ((b.y - a.y) * (p.x - a.x) < (p.y - a.y) * (b.x - a.x))
                break; // the last corner lies below the straight way past it: it stays
        }
        hull[n++] = p;
    }
    return n;
}

// A convex chain of corners, asked at rising x.
struct chain {
    const struct corner *corners;
    int count, at;
};

struct look {
    double y, left, right; // slopes; infinite beyond the ends
};

static double slope_after(const struct chain *c, int k)
{
    const struct corner a = c->corners[k], b = c->corners[k + 1];
    return b.x > a.x ? (b.y - a.y) / (b.x - a.x) : 0;
}

static struct look look_at(struct chain *c, double x)
{
    while (c->at < c->count - 1 && c->corners[c->at + 1].x <= x)
        c->at++;
    const struct corner from = c->corners[c->at];
    const double right = c->at < c->count - 1 ? slope_after(c, c->at) : (double)INFINITY;
    if (x > from.x)
        return (struct look){from.y + right * (x - from.x), right, right};
    return (struct look){from.y, c->at ? slope_after(c, c->at - 1) : -(double)INFINITY, right};
}

// Slope of the widest strip above all lows and below all highs. Where the hulls come closest any slope that both have
// gives it the same width: the middle one; 0 if all slopes fit.
static double widest_strip(const struct corner *highs, const struct corner *lows, int count, struct corner *room)
{
    struct corner *const above = room, *const below = room + count; // `below` is mirrored: its slopes have the other sign
    struct chain over = {above, lower_hull(highs, count, 1, above), 0};
    struct chain under = {below, lower_hull(lows, count, -1, below), 0};
    double narrowest = (double)INFINITY, low = -(double)INFINITY, high = (double)INFINITY;
    for (int i = 0, k = 0; i < over.count || k < under.count;) {
        const int is_over = k == under.count || (i < over.count && above[i].x <= below[k].x);
        const double x = is_over ? above[i].x : below[k].x;
        while (i < over.count && above[i].x == x)
            i++;
        while (k < under.count && below[k].x == x)
            k++;
        const struct look top = look_at(&over, x), bottom = look_at(&under, x);
        if (top.y + bottom.y < narrowest) {
            narrowest = top.y + bottom.y;
            low = fmax(top.left, -bottom.right);
            high = fmin(top.right, -bottom.left);
        }
    }
    if (!isfinite(low))
        return isfinite(high) ? high : 0;
    return isfinite(high) ? (low + high) / 2 : low;
}

// Upper and lower edge, at x = 0, of the strip with this slope, and the means of what lies beyond them.
struct edges {
    double top, bottom, mean_high, mean_low;
};

static struct edges edges_of(const struct corner *highs, const struct corner *lows, int count, double slope)
{
    struct edges e = {(double)INFINITY, -(double)INFINITY, 0, 0};
    for (int i = 0; i < count; i++) {
        const double high = highs[i].y - slope * highs[i].x, low = lows[i].y - slope * lows[i].x;
        e.top = fmin(e.top, high);
        e.bottom = fmax(e.bottom, low);
        e.mean_high += high;
        e.mean_low += low;
    }
    e.mean_high /= count;
    e.mean_low /= count;
    return e;
}

static double middle_s(const struct clock_sample *s)
{
    return 0.5 * (s->sent_s + s->received_s);
}

struct strip_fit clockfit_strip(const struct clock_sample *samples, int count, double nominal_freq, double curvature,
                                double floor_s, double crystal_sigma, double *room)
{
    struct corner *const highs = (struct corner *)room, *const lows = highs + count;
    const struct clock_sample *last = samples + count - 1;
    const double base_s = middle_s(last);
    for (int i = 0; i < count; i++) {
        const struct clock_sample *s = samples + i;
        const double x = middle_s(s) - base_s;
        // relative to the last sample: 64-bit clocks do not fit a double's ns
        const double y = (double)(s->clock - last->clock) / nominal_freq - 0.5 * curvature * x * x;
        highs[i] = (struct corner){x, y - (s->sent_s - base_s)};
        lows[i] = (struct corner){x, y - (s->received_s - base_s)};
    }
    struct strip_fit fit = {0, widest_strip(highs, lows, count, lows + count), 0};
    const double span_s = -highs[0].x;
    const struct edges first = edges_of(highs, lows, count, fit.slope);
    double strewn_s = first.mean_high - first.top;
    strewn_s += first.bottom - first.mean_low;
    fit.doubt_s = floor_s + 2 * strewn_s / count;
    // what little the first fraction of a second says about the frequency counts less than what crystals are like
    fit.slope /= span_s > 0 ? 1 + pow(fit.doubt_s / (span_s * crystal_sigma), 2) : (double)INFINITY;
    const struct edges found = edges_of(highs, lows, count, fit.slope);
    fit.offset_s = 0.5 * (found.top + found.bottom);
    return fit;
}
