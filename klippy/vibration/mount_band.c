// Band power of raw accelerometer messages; see mount_band.h.
#include "vibration/mount_band.h"

#include <stdlib.h>
#include <string.h>

static int32_t extended(int32_t value, int bits)
{
    const int32_t sign = 1 << (bits - 1);
    return (value ^ sign) - sign;
}

// 0 where the firmware says that it is no sample.
static int unpack(const struct mount_band *b, const uint8_t *raw, int32_t counts[3])
{
    if (b->packed) {
        if (raw[4] & 0x80)
            return 0;
        counts[0] = extended(raw[0] | (raw[3] & 0x1f) << 8, 13);
        counts[1] = extended(raw[1] | (raw[4] & 0x1f) << 8, 13);
        counts[2] = extended(raw[2] | (raw[3] & 0xe0) << 3 | (raw[4] & 0x60) << 6, 13);
        return 1;
    }
    for (int i = 0; i < 3; i++, raw += 2)
        counts[i] = extended(b->is_big_endian ? raw[0] << 8 | raw[1] : raw[1] << 8 | raw[0], 16);
    return 1;
}

static double filtered(struct mount_band *b, double x)
{
    for (int i = 0; i < b->section_count; i++) { // transposed direct form II
        const struct band_section *s = &b->sections[i];
        double *m = b->memory[i], y = s->b0 * x + m[0];
        m[0] = s->b1 * x - s->a1 * y + m[1];
        m[1] = s->b2 * x - s->a2 * y;
        x = y;
    }
    return x;
}

static void add(struct mount_band *b, const int32_t counts[3])
{
    double x = 0;
    int is_clipped = 0;
    b->same = memcmp(counts, b->last, sizeof b->last) ? 0 : b->same + 1;
    for (int i = 0; i < 3; i++) {
        x += b->weight[i] * counts[i];
        b->sum[i] += counts[i];
        is_clipped |= abs(counts[i]) >= b->clip_counts || abs(counts[i] - b->last[i]) >= b->clip_counts / 2;
    }
    memcpy(b->last, counts, sizeof b->last);
    b->clipped += is_clipped;
    if (b->next == 0)
        b->offset = x;
    const double y = filtered(b, x - b->offset);
    b->square_sum += y * y;
}

static void restart_window(struct mount_band *b)
{
    b->count = b->clipped = b->failures = 0;
    b->square_sum = b->sum[0] = b->sum[1] = b->sum[2] = 0;
}

static void close_window(struct mount_band *b, struct band_window *out)
{
    const int taken = b->count - b->failures;
    *out = (struct band_window){.first = b->next - b->count, .clipped = b->clipped, .same = b->same,
                                .failures = b->failures, .settled = b->next - b->count >= b->settled_from};
    if (taken) {
        out->power = b->square_sum / taken;
        for (int i = 0; i < 3; i++)
            out->mean[i] = b->sum[i] / taken;
    }
    restart_window(b);
}

int mount_band_take(struct mount_band *b, int64_t first, const uint8_t *data, int len, struct band_window *out, int max)
{
    const int size = b->packed ? 5 : 6;
    int windows = 0;
    if (first != b->next || first == 0) { // samples are missing, or this is the start
        restart_window(b);
        b->settled_from = first + b->settle_samples;
        if (b->next)
            b->next = first;
    }
    for (; len >= size; len -= size, data += size) {
        int32_t counts[3];
        if (unpack(b, data, counts)) {
            add(b, counts);
        } else {
            b->failures++;
            b->settled_from = b->next + b->settle_samples;
        }
        b->next = b->next ? b->next + 1 : first + 1;
        if (++b->count == b->window_samples) {
            if (windows < max)
                close_window(b, &out[windows++]);
            else
                restart_window(b);
        }
    }
    return windows;
}
