/* The simulated world as its owner (Python, or a test) sees it.
 *
 * Read by a C compiler and, with the lines that begin with '#' left out, by cffi: declarations
 * only, no macros. ../README.md says who owns time and in which order things happen.
 *
 * Units: seconds, mm, degrees Celsius. `now` is world time; it begins at the `start_s` given to world_new().
 * Functions returning int give an index or 0 on success, -1 on failure with the reason in world_error().
 */
#ifndef FERRITE_WORLD_API_H
#define FERRITE_WORLD_API_H
#include <stdint.h>

struct world;

/* One line between host and MCU. Probabilities are per byte, for each direction. */
struct world_link_options {
    double baud;          /* bits per second, 10 per byte; 0 = bytes take no time */
    double latency_s;     /* added to every chunk */
    double jitter_s;      /* plus a uniformly random part up to this */
    double corrupt, drop, duplicate;
};

/* A pin of one MCU; mcu < 0 means not connected. */
struct world_pin {
    int mcu, pin, inverted;
};

/* A thermocouple on the skin of nozzle `nozzle`; its amplifier gives volt_per_k from 0 degC on. */
struct world_reference_options {
    int nozzle;
    double gain, tau_s, volt_per_k, adc_volt, noise_lsb;
};

/* The switch between supply and bus of a nozzle's bridge, delay_s behind its pin; watchdog_s > 0: closed only while edges
 * of the pin come at least so often. */
struct world_supply_switch_options {
    struct world_pin enable;
    double delay_s, watchdog_s;
};

/* A nozzle and its bridge now. phase_ticks: as commanded; power_w: into the metal. */
struct world_nozzle_state {
    double skin_c, power_w, supply_v;
    int phase_ticks, supply_closed;
};

enum { WORLD_PROBE_MOTORS = 4 };

/* Height of the bed over x and y (mm, in the coordinates of the axes): a plane and one bump of Gauss' shape. */
struct world_bed {
    double height_mm, tilt_x, tilt_y;
    double bump_mm, bump_x_mm, bump_y_mm, bump_radius_mm;
};

/* A switch that closes where nozzle and bed, below the probe, are trigger_mm apart. z_shares: of each Z motor's place in the
 * height at x, y: [0] + [1] x + [2] y. With a control pin it is a BLTouch; `stuck`: its pin does not come out. */
struct world_probe_options {
    struct world_pin pin, control; /* pin: none if a gauge measures instead */
    int x_axis, y_axis, z_count, stuck;
    int z_axes[4];
    double z_shares[4][3];
    double x_offset_mm, y_offset_mm, trigger_mm, noise_mm;
    struct world_bed bed;
};

/* A probe that measures: a load cell under the nozzle of probe `probe`, or a coil there. Frequencies, coupling and drifts of
 * the coil: machine_gauge.c. */
struct world_gauge_options {
    int kind; /* enum gauge_kind */
    int probe;
    struct world_pin ready, clock, select, temperature; /* HX71x: DOUT, SCLK */
    int i2c_mcu, i2c_address;
    double clock_hz, rate_hz, rate_error;
    double noise; /* standard deviation of a conversion, g or Hz */
    double counts_per_g, stiffness_g_mm, tare_g, drift_g_s;
    double free_hz, coupling, decay_mm, coil_mm; /* coil_mm: height of the coil above the nozzle's tip */
    double coil_c, coil_c_per_s, coil_end_c;
    double drift_per_k, drift_per_k2, drift_per_k3, drift_near_per_k;
};

/* Ringing of the frame along X and Y: natural frequency (0: rigid) and damping of the masses, lag of the motors. */
struct world_frame {
    double frequency_hz[2], damping_ratio[2];
    double motor_hz;
};

/* The extruder's mount, shaken by the melt of nozzle `nozzle` (plant/mount.h); axis: 0 to 2, along which it swings. */
struct world_mount {
    int nozzle, axis;
    double frequency_hz, quality, amplitude_m_s2, exponent, flow_exponent;
    double motion_share; /* of the frame's motion along X and Y, in the mount's */
};

enum world_accelerometer_fault { WORLD_ACCEL_WORKS, WORLD_ACCEL_UNPLUGGED, WORLD_ACCEL_FROZEN, WORLD_ACCEL_SATURATED };

/* An accelerometer that rides on both axes. `kind`: enum accel_kind (plant/accel_chip.h). orientation: the printer's
 * axis, 1 to 3 with sign, that each of the sensor's own points along. On SPI it has a select pin, else an I2C address. */
struct world_accelerometer_options {
    int kind, fault;
    int orientation[3];
    struct world_pin select;
    int i2c_mcu, i2c_address;
    double noise_ug;   /* per sqrt(Hz); < 0: the chip's typical */
    double rate_error; /* of its own clock: 0.01 is 1 % fast */
};

/* The lines of a display's chip; those not connected have mcu < 0. On SPI of the hardware clock and data are not. select:
 * not inverted is active high. parallel: clock is E, data D4 to D7. */
enum world_panel_bus { WORLD_PANEL_SERIAL, WORLD_PANEL_PARALLEL, WORLD_PANEL_I2C };
enum { WORLD_PANEL_LINES = 4 };
struct world_panel_options {
    int bus;
    struct world_pin select, clock, is_data, reset;
    struct world_pin data[4];
    int i2c_mcu, i2c_address;
};

/* What a display has been sent: bits 0 to 7 a byte (parallel: four lines), bit 8 the is_data line, bits 12 and 13 this. */
enum world_panel_event { WORLD_PANEL_BYTE, WORLD_PANEL_SELECTED, WORLD_PANEL_RELEASED, WORLD_PANEL_RESET };

enum world_axis_role { WORLD_AXIS_X, WORLD_AXIS_Y, WORLD_AXIS_Z, WORLD_AXIS_E, WORLD_AXIS_OTHER };

struct world_axis_options {
    int role;                       /* enum world_axis_role: its column in the trace */
    int both_edges;                 /* 1: the driver steps on both edges of its step pin */
    int limited;                    /* 1: hard stops at min_mm and max_mm */
    int endstop_at_max;             /* 1: switch closed at and above endstop_mm, else at and below */
    struct world_pin step, dir, endstop;
    double mm_per_step;
    double start_mm, min_mm, max_mm, endstop_mm;
};

/* Where melt comes from: the axis that pushes the filament, -1 for none. */
struct world_feed {
    int axis;
    double filament_area_mm2;
};

/* What a nozzle did since world_watch(). commanded_s, off_s: after how long its bridge was commanded off, and without
 * voltage, for good; < 0: it is not. peak_above_c: above the greatest target since then, and above where it was. */
struct world_watch_state {
    int nozzle;
    double start_s, start_c, target_c, peak_c, peak_above_c, commanded_s, off_s;
    double before_j, after_j; /* into the metal: until it was commanded off, and since then */
};

struct world_axis_state {
    double position_mm;
    int64_t steps_forward, steps_backward;
    int64_t steps_lost;             /* against a hard stop */
};

struct world_link_state {
    uint64_t bytes_down, bytes_up;                  /* offered to the line: to the MCU, from the MCU */
    uint64_t corrupted, dropped, duplicated;        /* bytes, both directions */
    uint64_t overflowed;                            /* chunks lost: more waiting than a line can hold */
};

/* What the heater did under one target; written by the trace at its rate. */
struct world_target_epoch {
    double start_s;                 /* after world start */
    double from_c, target_c;
    double reach_s;                 /* until within band of the target, -1 never */
    double bound_s;                 /* the same at full phase all the time, from the nozzle's state; 0: no climb */
    double settle_s;                /* until within band for 2 s on end, -1 never */
    double shown_settle_s;          /* the same of the host's estimate */
    double overshoot_c;             /* beyond the target in the direction of travel, within 15 s of reaching it */
    double settled_seconds;         /* time observed after settling */
    double max_error_c;             /* |true - target| after settling */
    double error_sum;               /* sum of (true - target) * dt after settling */
    double square_error_sum;        /* sum of (true - target)^2 * dt after settling */
    double estimate_max_error_c;    /* |estimate - true| after settling */
};

struct world_figures {
    double peak_c, peak_power_w, energy_j, extruded_mm3, peak_flow_mm3_s;
    uint64_t rows;
};

/* What the host says; sigma, drift and supply are NaN until it does. */
enum world_channel {
    WORLD_TARGET_C, WORLD_ESTIMATE_C, WORLD_BED_TARGET_C, WORLD_MELT_TARGET_C, WORLD_WARNING, WORLD_SIGMA_C,
    WORLD_DRIFT_C, WORLD_SUPPLY, WORLD_CHANNELS
};

struct world *world_new(double start_s, uint64_t seed);
void world_free(struct world *w);
const char *world_error(const struct world *w);
double world_now(const struct world *w);

/* Building the machine; all of it before the first world_advance(). */
int world_add_mcu(struct world *w, const char *library, double clock_hz, double clock_ppm,
                  const struct world_link_options *link);
/* Temperature of the chip's own sensor, 25 degC at first; may be set at any time. */
int world_set_chip_temperature(struct world *w, int mcu, double temp_c);
/* The image an emulator runs (klippy/simulation/emulator/emulator.h); once, before the first world_advance(). */
int world_load_image(struct world *w, int mcu, const char *image);
int world_add_axis(struct world *w, const struct world_axis_options *options);
int world_add_probe(struct world *w, const struct world_probe_options *options);
int world_add_frame(struct world *w, const struct world_frame *options);
int world_add_mount(struct world *w, const struct world_mount *options);
int world_add_accelerometer(struct world *w, const struct world_accelerometer_options *options);
/* May be set at any time. */
int world_set_accelerometer_fault(struct world *w, int accelerometer, int fault);
int world_add_gauge(struct world *w, const struct world_gauge_options *options);
/* Temperature of a gauge's coil now. */
double world_coil_temperature(const struct world *w, int gauge);
int world_add_panel(struct world *w, const struct world_panel_options *options);
/* Events since the last call, the oldest first; returns how many. -1 if more have come in between than are kept. */
int world_read_panel(struct world *w, int panel, uint16_t *out, uint32_t capacity);
/* The level of a line that nothing else of the machine drives: a button, a knob. */
int world_set_input(struct world *w, struct world_pin pin, int level);
/* Place (mm) of the mass on axis 0 (X) or 1 (Y) of the frame; NAN without a frame. */
double world_frame_place(const struct world *w, int axis);
double world_bed_height(const struct world *w, int probe, double x, double y);
/* The carriage of `axis` goes own_share of its motor's way plus partner_share of that of the motor of `partner`. */
int world_couple_axes(struct world *w, int axis, int partner, double own_share, double partner_share);
int world_add_fan(struct world *w, struct world_pin pin, double spin_up_s);
int world_add_nozzle(struct world *w, int mcu, const double *parameters, struct world_feed feed, int fan);
int world_add_load(struct world *w, const double *parameters, int is_bed, struct world_pin heater,
                   struct world_pin sensor, struct world_feed feed, int fan);
int world_add_reference(struct world *w, const struct world_reference_options *options, struct world_pin pin);
/* The bridge's supply over a divider: full_scale_v at the ADC's highest code. */
int world_add_supply_sensor(struct world *w, int nozzle, struct world_pin pin, double full_scale_v);
int world_add_supply_switch(struct world *w, int nozzle, const struct world_supply_switch_options *options);
/* A parameter over time since the start: straight lines between the points, constant beyond them. */
int world_add_profile(struct world *w, int nozzle, int index, const double *times_s, const double *values, int count);
int world_nozzle(const struct world *w, int nozzle, struct world_nozzle_state *out);
double world_nozzle_temperature(const struct world *w, int nozzle);
double world_load_temperature(const struct world *w, int load);
double world_fan_speed(const struct world *w, int fan);

/* A parameter changes while the machine runs: faults, drift, disturbances. Indices as in world_parameter(). */
void world_set_nozzle_parameter(struct world *w, int nozzle, int index, double value);
double world_nozzle_parameter(const struct world *w, int nozzle, int index);
void world_set_load_parameter(struct world *w, int load, int index, double value);

/* Faults of everything else. Lines are cut and the host stands still until `until_s`, world time; a clock goes by another
 * rate from now on; an MCU starts anew as after power-on. world_stop_adc: not for an emulated chip. */
void world_cut_link(struct world *w, int mcu, int down, int up, double until_s);
void world_damage_link(struct world *w, int mcu, double corrupt);
void world_step_clock(struct world *w, int mcu, double ppm);
int world_stop_adc(struct world *w, int mcu);
void world_reset_mcu(struct world *w, int mcu);
void world_stall_host(struct world *w, double until_s);
void world_stick_fan(struct world *w, int fan, double speed);
/* From now on look at a nozzle; returns an index. */
int world_watch(struct world *w, int nozzle);
int world_watched(const struct world *w, int watch, struct world_watch_state *out);

/* The parameters of a nozzle (table 0) and of a load (table 1): 0 when index is past the end.
 * values: min, max, then those of each preset: reference, strong, real; or hotend, bed. */
int world_parameter(int table, int index, const char **name, const char **unit, const char **doc, double *values);

/* Host side of a link: a serial queue (addresses of serialqueue, serialqueue_receive and
 * serialqueue_transmit of chelper/link/serialqueue.h), or none and bytes by feed and drain. */
int world_attach(struct world *w, int mcu, uintptr_t queue, uintptr_t receive, uintptr_t transmit);
void world_detach(struct world *w, int mcu);
void world_feed(struct world *w, int mcu, const uint8_t *data, uint32_t length);
uint32_t world_drain(struct world *w, int mcu, uint8_t *data, uint32_t capacity);

/* Let time pass up to `until_s`. Returns a bit per MCU (1 << index) whose host queue holds messages;
 * when any is set `now` may be earlier than `until_s`. */
uint32_t world_advance(struct world *w, double until_s);

/* 1 if the model of an emulated chip has objected to what its firmware did: that MCU stands still, and world_error() says
 * why. */
int world_failed(const struct world *w);
/* Address of a function of the library of one MCU, 0 if it has none of that name. */
uintptr_t world_symbol(struct world *w, int mcu, const char *name);

/* CSV at `rate_hz`; path may be NULL: figures only. world_trace_close() flushes; -1 if the disc was full. */
int world_trace_open(struct world *w, const char *path, double rate_hz);
int world_trace_close(struct world *w);
void world_set_channel(struct world *w, int channel, double value);

void world_axis(const struct world *w, int axis, struct world_axis_state *out);
void world_link(const struct world *w, int mcu, struct world_link_state *out);
void world_figures(const struct world *w, struct world_figures *out);
int world_epoch(const struct world *w, int index, struct world_target_epoch *out);

#endif
