#ifndef CHELPER_DRIVE_OFFSET_H
#define CHELPER_DRIVE_OFFSET_H
// What the drive by itself adds to the reading. A step of the drive cannot step the temperature: by how much the reading
// steps is the error of the sensing law at the stronger drive, whatever its cause (supply, dead time, resistance of the
// steel). The reading at the sensing phase is taken for the truth.
//
//     reading = T + k h,    h = (phase/phase_max)^2.6,    k (degC at full drive) walks at random
//
// Between the centres of two blocks the temperature changes by the heat balance; the rest of a step is k's.
//
// A supply with ripple moves k from block to block, and looks may keep step with it. Blocks at one strong drive show how far:
// the doubt about k is no less than that, so strong drives count for little, and each command begins with a look.
//
// The actuator puts short looks at the sensing phase into a strong drive, so that there are steps.

struct coil_block;
struct filter_params;
struct filter_state;

struct drive_offset {
    double full_c, variance;        // k and its variance, degC at full drive
    double swing;                   // mean square of k's jumps between blocks at one strong drive; 0: none yet
    double time_s;                  // centre of the newest block with a reading; NaN: none yet
    double reading_c, temp_c, noise_c;  // its reading, and corrected
    double lever;                   // its h
    double strong;                  // h of the newest strong drive
    double heat_w, half_s;          // its heat and half its duration
};

void drive_offset_reset(struct drive_offset *s);
// Learns from one block's reading and corrects it. `rate_k_s`: heating that the model does not explain.
void drive_offset_block(struct drive_offset *s, const struct filter_params *p, double rate_k_s, double phase_max,
                        struct coil_block *block);

#endif
