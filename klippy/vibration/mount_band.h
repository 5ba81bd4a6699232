#ifndef VIBRATION_MOUNT_BAND_H
#define VIBRATION_MOUNT_BAND_H
// Power of an accelerometer's samples in a band, window by window, from the raw bytes of its messages.
//
//     bytes ──► counts of x, y, z ──► along one axis (weight), less the first sample ──► second-order sections ──► mean square
//
// Beside it what shows a broken sensor: the means, the samples at the end of the range, those without any change.

#include <stdint.h>

enum { BAND_SECTIONS = 8 };

// y = b0 x + b1 x' + b2 x" - a1 y' - a2 y"
struct band_section {
    double b0, b1, b2, a1, a2;
};

struct band_window {
    int64_t first;       // number of its first sample
    double power;        // mean square, (m/s^2)^2
    double mean[3];      // counts
    int32_t clipped;     // samples at the end of the range, or half the range from the one before: damaged data
    int32_t same;        // newest samples that are alike in all bits
    int32_t failures;    // samples that the firmware says are none
    int32_t settled;     // 0: too soon after a gap for `power`
};

struct mount_band {
    struct band_section sections[BAND_SECTIONS];
    int32_t section_count, window_samples, settle_samples;
    int32_t packed;        // 1: five bytes of an ADXL345; 0: six, 16 bits an axis
    int32_t is_big_endian;
    int32_t clip_counts;   // from here on a count is at the end of the range
    double weight[3];      // m/s^2 a count
    // memory; zero at the start
    double memory[BAND_SECTIONS][2];
    double offset;         // first sample
    int64_t next;          // number of the sample that is expected; 0 at the start
    int64_t settled_from;
    int32_t count, same, clipped, failures;
    int32_t last[3];
    double square_sum, sum[3];
};

// Whole samples, the first with number `first`. Number of windows that ended, at most `max` (what is beyond is lost).
int mount_band_take(struct mount_band *b, int64_t first, const uint8_t *data, int len, struct band_window *out, int max);

#endif
