/* The printer around the electronics: what a pin moves, heats or reads.
 *
 *   step, dir pin ──► axis ──► position ──► switch ──► endstop pin
 *                       └────► melt flow ──┐
 *   fan pin ──► mean duty ──► fan speed ───┼──► nozzle (struct plant) ◄── bridge phase,  ──► ADC samples
 *   heater pin ──► mean duty ──────────────┴──► load (struct thermal_load) ──► thermistor pin
 *   axes ──► place of the probe ──► bed's surface ──► probe pin; control pin ──► a BLTouch's pin
 *                                              └────► force, or frequency of a coil ──► chip on pins, SPI or I2C (machine_gauge.c)
 *   bridge supply, divider ──► vdc_pin;  enable pin ──► switch in that supply
 *   a thermocouple on the nozzle's skin, for calibrating: gain and lag, amplifier ──► reference pin
 *
 * Times are world seconds. The pins of one MCU report here in the order of time. machine_tick() once a millisecond
 * brings duties, flow and temperatures up to date.
 */
#ifndef FERRITE_MACHINE_H
#define FERRITE_MACHINE_H

#include <stdint.h>
#include "accel_chip.h"
#include "frame.h"
#include "gauge_chip.h"
#include "mount.h"
#include "plant.h"
#include "thermal_load.h"
#include "world_api.h"

enum {
    MACHINE_MCUS = 16,
    MACHINE_PINS = 128,
    MACHINE_AXES = 16,
    MACHINE_FANS = 16,
    MACHINE_LOADS = 8,
    MACHINE_NOZZLES = 4,
    MACHINE_REFERENCES = 4,
    MACHINE_PROBES = 4,
    MACHINE_ACCELEROMETERS = 4,
    MACHINE_GAUGES = 4,
    MACHINE_PANELS = 2,
    MACHINE_PANEL_EVENTS = 1 << 16,
    NOZZLE_PROFILES = 16,
    PROFILE_POINTS = 32,
    MACHINE_DUTIES = MACHINE_FANS + MACHINE_LOADS,
};

enum pin_role { PIN_UNUSED, PIN_STEP, PIN_DUTY, PIN_SWITCH, PIN_THERMISTOR, PIN_REFERENCE, PIN_PROBE, PIN_CONTROL,
                PIN_SUPPLY, PIN_ENABLE, PIN_SELECT, PIN_PANEL, PIN_GAUGE,
                PIN_GAUGE_CLOCK, PIN_GAUGE_SELECT, PIN_COIL_SENSOR };

struct machine_pin {
    uint8_t role;   /* enum pin_role */
    uint8_t target; /* index into the table of that role */
    uint8_t level;  /* last written */
};

/* A motor and the carriage it is named after. Usually one moves the other; on a core machine the carriage goes by a
 * mix of its own motor's way and a partner's. */
struct axis {
    struct world_axis_options options;
    int64_t step;               /* of the motor; 0 at the start */
    struct axis *partner;       /* NULL: none */
    double own_share, partner_share; /* of the motors' ways in the carriage's */
    int64_t forward, backward, lost;
};

/* Time average of something that is switched: software or hardware PWM alike. */
struct duty {
    int inverted;
    double level;    /* 0..1 now */
    double since_s;  /* of the last change or reading */
    double on_s;     /* integral of level since the last reading */
    double mean_since_s;
};

struct fan {
    int duty;
    double spin_up_s;
    double speed; /* 0..1 */
    int stuck;    /* at that speed */
};

/* Melt pushed by an axis. */
struct feed {
    struct world_feed options;
    int64_t mark; /* farthest step so far: only beyond it does melt leave the nozzle */
    double flow_mm3_s;
    double volume_mm3;
};

/* A parameter of a plant over time since the start. */
struct profile {
    int index, count;
    double time_s[PROFILE_POINTS], value[PROFILE_POINTS];
};

/* The switch in a bridge's supply: follows its pin by a delay. With a watchdog it is closed only while edges come. */
struct supply_switch {
    struct world_supply_switch_options options;
    int present, asked, closed;
    double asked_s, edge_s; /* of the last change of `asked`, of the last edge */
};

struct nozzle {
    struct plant plant;
    struct feed feed;
    int fan; /* -1: none */
    int mcu;
    double time_s; /* up to which the plant has been advanced */
    uint16_t phase;
    double supply_full_scale_v; /* of vdc_pin */
    struct supply_switch supply_switch;
    double start_s;             /* of the profiles */
    struct profile profiles[NOZZLE_PROFILES];
    int profile_count;
};

/* A thermocouple on a nozzle, behind the skin (Table 6 of Oskolkov 2021: gain about 25 degC, first-order lag). */
struct reference {
    struct world_reference_options options;
    double temp_c;
    uint32_t noise; /* state of its generator */
};

/* A probe; with a control pin a BLTouch. */
struct probe {
    struct world_probe_options options;
    double error_mm; /* of this approach */
    uint32_t noise;  /* state of its generator */
    int touched, pin_out, touch_mode, pulses;
    double rise_s, pulse_end_s;
};

/* On SPI (select) or I2C. `last_`: of its sample before. */
struct accelerometer {
    struct world_accelerometer_options options;
    struct accel_chip chip;
    uint32_t noise; /* state of its generator */
    int fault;      /* enum accel_fault */
    double rate_hz; /* of its registers, at the last tick */
    double next_s, last_rate[FRAME_AXES + 1], frozen[3];
};

/* A probe that measures. `sum`: integral of the signal since the last conversion, up to time_s. */
struct gauge {
    struct world_gauge_options options;
    struct gauge_chip chip;
    uint32_t noise; /* state of its generator */
    double start_s, time_s, next_s, sum;
};

/* A display: what its chip has been sent and nobody has read yet, a ring. */
struct panel {
    struct world_panel_options options;
    uint8_t shift, bits; /* of the byte under way */
    int lost;            /* the ring was full */
    uint32_t first, count;
    uint16_t events[MACHINE_PANEL_EVENTS];
};

struct load {
    struct thermal_load thermal;
    struct feed feed;
    int fan, duty, is_bed;
    double time_s;
    double duty_mean;
};

struct machine {
    struct machine_pin pins[MACHINE_MCUS][MACHINE_PINS];
    struct axis axes[MACHINE_AXES];
    struct duty duties[MACHINE_DUTIES];
    struct fan fans[MACHINE_FANS];
    struct nozzle nozzles[MACHINE_NOZZLES];
    struct load loads[MACHINE_LOADS];
    struct reference references[MACHINE_REFERENCES];
    struct probe probes[MACHINE_PROBES];
    struct accelerometer accelerometers[MACHINE_ACCELEROMETERS];
    struct gauge gauges[MACHINE_GAUGES];
    struct panel panels[MACHINE_PANELS];
    struct frame_axis frame[FRAME_AXES];
    int frame_of[FRAME_AXES]; /* indices of axes X and Y */
    int has_frame;
    struct mount mount;
    int has_mount, mount_nozzle, mount_axis; /* axis: 0 to 2 */
    double frame_s, frame_step_s; /* up to when it has been advanced */
    double frame_rates[FRAME_AXES + 1]; /* of its axes and of the mount, a step before */
    int axis_count, duty_count, fan_count, nozzle_count, load_count, reference_count, probe_count;
    int accelerometer_count, panel_count, gauge_count;
    int nozzle_of_mcu[MACHINE_MCUS]; /* index, -1 */
    double chip_temp_c[MACHINE_MCUS];
};

void machine_init(struct machine *m);

/* Building. All return an index, or -1 if the table is full or a pin is out of range. */
int machine_add_axis(struct machine *m, const struct world_axis_options *options);
int machine_couple_axes(struct machine *m, int axis, int partner, double own_share, double partner_share);
int machine_add_probe(struct machine *m, const struct world_probe_options *options, uint32_t seed);
int machine_add_frame(struct machine *m, const struct world_frame *options, double now_s);
int machine_add_mount(struct machine *m, const struct world_mount *options, uint64_t seed);
int machine_add_accelerometer(struct machine *m, const struct world_accelerometer_options *options, uint32_t seed);
int machine_add_gauge(struct machine *m, const struct world_gauge_options *options, uint32_t seed, double now_s);
int machine_add_panel(struct machine *m, const struct world_panel_options *options);
int machine_add_duty(struct machine *m, struct world_pin pin, double now_s);
int machine_add_fan(struct machine *m, struct world_pin pin, double spin_up_s, double now_s);

/* Events from the pins of MCU `mcu`. */
void machine_pin_write(struct machine *m, int mcu, uint32_t pin, uint8_t value, double now_s);
void machine_pwm_write(struct machine *m, int mcu, uint32_t pin, double level, double now_s);
uint8_t machine_pin_read(struct machine *m, int mcu, uint32_t pin, double now_s);
uint16_t machine_adc_read(struct machine *m, int mcu, uint32_t pin, double now_s);
void machine_bridge_set(struct machine *m, int mcu, uint16_t phase, double now_s);
void machine_sample(struct machine *m, int mcu, uint16_t *out, uint32_t count, double first_s, double period_s);
void machine_move_sampling(struct machine *m, int mcu, double late_s);
void machine_spi_exchange(struct machine *m, int mcu, uint8_t *data, uint32_t len, double now_s);
uint8_t machine_i2c_exchange(struct machine *m, int mcu, uint8_t address, const uint8_t *write, uint32_t write_len,
                             uint8_t *read, uint32_t read_len, double now_s);
void machine_reset_outputs(struct machine *m, int mcu, double now_s); /* the MCU restarts: everything it drives is off */

/* `now_s` - the last tick = tick_s. */
void machine_tick(struct machine *m, double now_s, double tick_s);

int machine_set_input(struct machine *m, struct world_pin pin, int level);
uint32_t machine_read_panel(struct machine *m, int panel, uint16_t *out, uint32_t capacity);

double probe_gap_mm(const struct machine *m, const struct probe *p, double dx_mm, double dy_mm);
void gauges_advance(struct machine *m, double now_s);
double gauge_coil_c(const struct gauge *g, double now_s);
uint8_t gauge_level(struct machine *m, int index, double now_s);
void gauge_clock(struct machine *m, int index, uint8_t level, double now_s);
uint16_t gauge_temperature_code(const struct machine *m, int index, double now_s);
int gauges_spi(struct machine *m, int mcu, uint8_t *data, uint32_t len, double now_s);
int gauges_i2c(struct machine *m, int mcu, uint8_t address, const uint8_t *write, uint32_t write_len, uint8_t *read,
               uint32_t read_len, double now_s);
void panel_pin_changed(const struct machine *m, struct panel *p, int mcu, uint32_t number, uint8_t value);
void panels_spi(struct machine *m, int mcu, const uint8_t *data, uint32_t len);
int panels_i2c(struct machine *m, int mcu, uint8_t address, const uint8_t *write, uint32_t write_len);
double axis_position_mm(const struct axis *a);
uint8_t probe_level(const struct machine *m, struct probe *p, double now_s);
void probe_control(struct probe *p, uint8_t level, double now_s);
void mount_tick(struct machine *m);
void frame_advance(struct machine *m, double now_s);
void accelerometer_select(struct accelerometer *a, uint8_t level);
double bed_height_mm(const struct world_bed *b, double x, double y);
void nozzle_advance(struct nozzle *n, double now_s);

#endif
