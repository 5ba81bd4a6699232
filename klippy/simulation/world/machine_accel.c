/* The ringing frame, the extruder's mount, and the accelerometers on them: their buses, mounting, noise and faults.
 *
 *     steps ──► frame (plant/frame.h) ──────────────┬─► mean acceleration since the last sample, as a chip's filter makes it
 *     melt ──► back force ──► mount (mount.h) ──────┘
 *           + gravity ──► turned as the sensor is mounted ──► noise ──► registers (plant/accel_chip.h) ◄──► SPI or I2C
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "machine.h"

static const double GRAVITY_M_S2 = 9.80665;
static const double M_PER_MM = 1e-3;
static const double FRAME_SLOW_RATE_HZ = 1000.0;
static const double BEYOND_ANY_RANGE_M_S2 = 1e4;
enum { I2C_DONE = 0, I2C_NO_DEVICE = 3 }; /* of src/board/i2c_status.h */

static void set_step(struct machine *m, double step_s)
{
    m->frame_step_s = step_s;
    for (int i = 0; i < FRAME_AXES; i++)
        frame_axis_set_step(&m->frame[i], step_s);
    if (m->has_mount)
        mount_set_step(&m->mount, step_s);
}

int machine_add_frame(struct machine *m, const struct world_frame *o, double now_s)
{
    static const int roles[FRAME_AXES] = { WORLD_AXIS_X, WORLD_AXIS_Y };
    for (int i = 0; i < FRAME_AXES; i++) {
        int axis = 0;
        while (axis < m->axis_count && m->axes[axis].options.role != roles[i])
            axis++;
        if (axis == m->axis_count)
            return -1;
        m->frame_of[i] = axis;
        frame_axis_init(&m->frame[i], o->frequency_hz[i], o->damping_ratio[i], o->motor_hz,
                        axis_position_mm(&m->axes[axis]));
    }
    m->has_frame = 1;
    m->frame_s = now_s;
    set_step(m, FRAME_STEP_S);
    return 0;
}

static double mount_base_mm(const struct machine *m)
{
    return m->mount.motion_share * (m->frame[0].x + m->frame[1].x);
}

int machine_add_mount(struct machine *m, const struct world_mount *o, uint64_t seed)
{
    if (!m->has_frame || o->nozzle < 0 || o->nozzle >= m->nozzle_count || o->axis < 0 || o->axis > 2)
        return -1;
    m->mount = (struct mount){ .frequency_hz = o->frequency_hz, .quality = o->quality, .exponent = o->exponent,
                               .amplitude_m_s2 = o->amplitude_m_s2, .flow_exponent = o->flow_exponent,
                               .motion_share = o->motion_share };
    mount_init(&m->mount, mount_base_mm(m), seed);
    m->has_mount = 1;
    m->mount_nozzle = o->nozzle;
    m->mount_axis = o->axis;
    set_step(m, m->frame_step_s);
    return 0;
}

/* The chips' rates; slow ones need no fine steps. */
void mount_tick(struct machine *m)
{
    if (!m->has_frame)
        return;
    double step_s = FRAME_SLOW_STEP_S;
    for (int i = 0; i < m->accelerometer_count; i++) {
        m->accelerometers[i].rate_hz = accel_chip_rate(&m->accelerometers[i].chip);
        if (m->accelerometers[i].rate_hz > FRAME_SLOW_RATE_HZ)
            step_s = FRAME_STEP_S;
    }
    if (step_s != m->frame_step_s)
        set_step(m, step_s);
    if (m->has_mount)
        mount_follow(&m->mount, &m->nozzles[m->mount_nozzle].plant);
}

int machine_add_accelerometer(struct machine *m, const struct world_accelerometer_options *o, uint32_t seed)
{
    if (m->accelerometer_count == MACHINE_ACCELEROMETERS || o->kind < 0 || o->kind >= ACCEL_KINDS || !m->has_frame)
        return -1;
    for (int i = 0; i < 3; i++)
        if (o->orientation[i] == 0 || abs(o->orientation[i]) > 3)
            return -1;
    int has_select = o->select.mcu >= 0;
    if (has_select && (o->select.mcu >= MACHINE_MCUS || o->select.pin < 0 || o->select.pin >= MACHINE_PINS))
        return -1;
    struct accelerometer *a = &m->accelerometers[m->accelerometer_count];
    *a = (struct accelerometer){ .options = *o, .noise = seed, .fault = o->fault };
    accel_chip_init(&a->chip, (enum accel_kind)o->kind);
    if (a->options.noise_ug < 0.0)
        a->options.noise_ug = accel_chip_noise(a->chip.kind);
    if (has_select) {
        struct machine_pin *pin = &m->pins[o->select.mcu][o->select.pin];
        pin->role = PIN_SELECT;
        pin->target = (uint8_t)m->accelerometer_count;
        pin->level = !o->select.inverted; /* idle */
    }
    return m->accelerometer_count++;
}

/* About Gaussian, standard deviation 1. */
static double draw(struct accelerometer *a)
{
    double sum = 0.0;
    for (int i = 0; i < 4; i++) {
        a->noise = a->noise * 1664525u + 1013904223u;
        sum += a->noise / 4294967296.0 - 0.5;
    }
    return sum * 1.7320508075688772;
}

/* Speeds of the frame's axes and of the mount (mm/s) at a time in the step that ends at frame_s. */
static void speeds_at(const struct machine *m, double time_s, double out[FRAME_AXES + 1])
{
    double left = (m->frame_s - time_s) / m->frame_step_s;
    for (int i = 0; i <= FRAME_AXES; i++) {
        double now = i < FRAME_AXES ? m->frame[i].x_rate : m->mount.rate;
        out[i] = now - left * (now - m->frame_rates[i]);
    }
}

static void take_sample(struct machine *m, struct accelerometer *a, double rate)
{
    double along[3] = { 0.0, 0.0, GRAVITY_M_S2 }, seen[3], speeds[FRAME_AXES + 1];
    speeds_at(m, a->next_s, speeds);
    for (int i = 0; i <= FRAME_AXES; i++)
        along[i < FRAME_AXES ? i : m->mount_axis] += (speeds[i] - a->last_rate[i]) * rate * M_PER_MM;
    memcpy(a->last_rate, speeds, sizeof speeds);
    double noise = a->options.noise_ug * 1e-6 * GRAVITY_M_S2 * sqrt(0.5 * rate);
    for (int i = 0; i < 3; i++) {
        int axis = a->options.orientation[i];
        seen[i] = (axis < 0 ? -1.0 : 1.0) * along[abs(axis) - 1] + noise * draw(a);
        if (a->fault == ACCEL_SATURATED)
            seen[i] = BEYOND_ANY_RANGE_M_S2;
    }
    if (a->fault == ACCEL_FROZEN)
        memcpy(seen, a->frozen, sizeof seen);
    memcpy(a->frozen, seen, sizeof seen);
    accel_chip_sample(&a->chip, seen);
}

static void sample_if_due(struct machine *m, struct accelerometer *a)
{
    double rate = a->rate_hz;
    if (rate <= 0.0) {
        a->next_s = 0.0;
        return;
    }
    rate *= 1.0 + a->options.rate_error;
    if (a->next_s == 0.0) { /* just switched on */
        a->next_s = m->frame_s + 1.0 / rate;
        speeds_at(m, m->frame_s, a->last_rate);
    }
    if (m->frame_s < a->next_s)
        return;
    take_sample(m, a, rate);
    a->next_s += 1.0 / rate;
}

void frame_advance(struct machine *m, double now_s)
{
    if (!m->has_frame)
        return;
    while (m->frame_s + m->frame_step_s <= now_s) {
        m->frame_s += m->frame_step_s;
        for (int i = 0; i < FRAME_AXES; i++) {
            m->frame_rates[i] = m->frame[i].x_rate;
            frame_axis_step(&m->frame[i], axis_position_mm(&m->axes[m->frame_of[i]]));
        }
        m->frame_rates[FRAME_AXES] = m->mount.rate;
        if (m->has_mount)
            mount_step(&m->mount, mount_base_mm(m), m->mount.motion_share * (m->frame[0].x_rate + m->frame[1].x_rate));
        for (int i = 0; i < m->accelerometer_count; i++)
            sample_if_due(m, &m->accelerometers[i]);
    }
}

/* ---- buses ----------------------------------------------------------------------------------- */

static int is_selected(const struct machine *m, const struct accelerometer *a, int mcu)
{
    struct world_pin p = a->options.select;
    return p.mcu == mcu && m->pins[mcu][p.pin].level == (p.inverted != 0);
}

void accelerometer_select(struct accelerometer *a, uint8_t level)
{
    if (level == (a->options.select.inverted != 0))
        accel_chip_spi_select(&a->chip);
}

void machine_spi_exchange(struct machine *m, int mcu, uint8_t *data, uint32_t len, double now_s)
{
    panels_spi(m, mcu, data, len);
    if (gauges_spi(m, mcu, data, len, now_s))
        return;
    struct accelerometer *selected = NULL;
    for (int i = 0; i < m->accelerometer_count; i++)
        if (is_selected(m, &m->accelerometers[i], mcu))
            selected = &m->accelerometers[i];
    if (!selected || selected->fault == ACCEL_UNPLUGGED) {
        memset(data, 0xff, len); /* the line is pulled up */
        return;
    }
    frame_advance(m, now_s);
    for (uint32_t i = 0; i < len; i++)
        data[i] = accel_chip_spi_byte(&selected->chip, data[i]);
}

uint8_t machine_i2c_exchange(struct machine *m, int mcu, uint8_t address, const uint8_t *write, uint32_t write_len,
                             uint8_t *read, uint32_t read_len, double now_s)
{
    for (int i = 0; i < m->accelerometer_count; i++) {
        struct accelerometer *a = &m->accelerometers[i];
        if (a->options.i2c_mcu != mcu || a->options.i2c_address != address || a->fault == ACCEL_UNPLUGGED)
            continue;
        frame_advance(m, now_s);
        accel_chip_i2c(&a->chip, write, write_len, read, read_len);
        return I2C_DONE;
    }
    if (gauges_i2c(m, mcu, address, write, write_len, read, read_len, now_s))
        return I2C_DONE;
    if (panels_i2c(m, mcu, address, write, write_len))
        return I2C_DONE;
    memset(read, 0xff, read_len);
    return I2C_NO_DEVICE;
}
