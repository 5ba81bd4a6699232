/* One simulated MCU: its library, its clock, and what its pins meet.
 *
 * The border between the MCU's ticks and the world's seconds. A tick count is turned into seconds by one division, and
 * back by floor(); the margin in to_clock() makes the two agree for an event that is due exactly now (a double
 * resolves 1e-3 tick after a day).
 */
#include <dlfcn.h>
#include <string.h>

#include "world_internal.h"

static const double CLOCK_MARGIN_TICKS = 0.01;
static const double SIM_PWM_MAX = 255.0; /* constant PWM_MAX of the simulator port */

static double to_seconds(const struct world_mcu *m, uint64_t clock)
{
    return m->clock_base_s + ((double)clock - m->clock_base) / m->clock_hz;
}

static uint64_t to_clock(const struct world_mcu *m, double time_s)
{
    return (uint64_t)floor(m->clock_base + (time_s - m->clock_base_s) * m->clock_hz + CLOCK_MARGIN_TICKS);
}

/* ---- what the board offers the firmware (struct sim_board) ------------------------------------ */

static void on_pin_write(void *ctx, uint32_t pin, uint8_t value, uint64_t clock)
{
    struct world_mcu *m = ctx;
    machine_pin_write(&m->world->machine, m->index, pin, value, to_seconds(m, clock));
}

static uint8_t on_pin_read(void *ctx, uint32_t pin, uint64_t clock)
{
    struct world_mcu *m = ctx;
    return machine_pin_read(&m->world->machine, m->index, pin, to_seconds(m, clock));
}

static void on_pwm_write(void *ctx, uint32_t pin, uint32_t cycle_ticks, uint32_t value, uint64_t clock)
{
    struct world_mcu *m = ctx;
    (void)cycle_ticks; /* heaters and fans are slow: only the mean matters */
    machine_pwm_write(&m->world->machine, m->index, pin, value / SIM_PWM_MAX, to_seconds(m, clock));
}

static uint16_t on_adc_read(void *ctx, uint32_t pin, uint64_t clock)
{
    struct world_mcu *m = ctx;
    return machine_adc_read(&m->world->machine, m->index, pin, to_seconds(m, clock));
}

static void on_bridge_set(void *ctx, uint16_t phase, uint64_t clock)
{
    struct world_mcu *m = ctx;
    machine_bridge_set(&m->world->machine, m->index, phase, to_seconds(m, clock));
}

static void on_sync_adc_read(void *ctx, uint16_t *samples, uint32_t count, uint64_t first_clock,
                             uint32_t period_ticks)
{
    struct world_mcu *m = ctx;
    machine_sample(&m->world->machine, m->index, samples, count, to_seconds(m, first_clock),
                   period_ticks / m->clock_hz);
}

static void on_sync_adc_move(void *ctx, uint32_t ticks, uint64_t clock)
{
    struct world_mcu *m = ctx;
    (void)clock;
    machine_move_sampling(&m->world->machine, m->index, ticks / m->clock_hz);
}

static void on_console_send(void *ctx, const uint8_t *data, uint32_t len, uint64_t clock)
{
    struct world_mcu *m = ctx;
    link_send(&m->up, data, len, to_seconds(m, clock));
}

static void on_spi_exchange(void *ctx, uint32_t bus, uint8_t mode, uint8_t *data, uint32_t len, uint64_t clock)
{
    struct world_mcu *m = ctx;
    (void)bus, (void)mode; /* a chip is known by its select pin */
    machine_spi_exchange(&m->world->machine, m->index, data, len, to_seconds(m, clock));
}

static uint8_t on_i2c_exchange(void *ctx, uint32_t bus, uint8_t address, const uint8_t *write, uint32_t write_len,
                               uint8_t *read, uint32_t read_len, uint64_t clock)
{
    struct world_mcu *m = ctx;
    (void)bus; /* one device of an address on an MCU */
    return machine_i2c_exchange(&m->world->machine, m->index, address, write, write_len, read, read_len,
                                to_seconds(m, clock));
}

/* ---- the library ------------------------------------------------------------------------------ */

static int find_function(struct world_mcu *m, const char *name, void *out)
{
    void *address = dlsym(m->library.handle, name);
    if (!address)
        return world_fail(m->world, "the simulated firmware lacks the function %s", name);
    memcpy(out, &address, sizeof address); /* ISO C has no cast from object to function pointer */
    return 0;
}

static void find_optional(struct world_mcu *m, const char *name, void *out)
{
    void *address = dlsym(m->library.handle, name);
    memcpy(out, &address, sizeof address);
}

int world_mcu_load_image(struct world_mcu *m, const char *image)
{
    if (!m->library.load_image)
        return world_fail(m->world, "this simulated MCU is no emulator: it runs no image");
    const char *error = m->library.load_image(image);
    return error ? world_fail(m->world, "%s", error) : 0;
}

int world_mcu_load(struct world_mcu *m, const char *path)
{
    struct mcu_library *l = &m->library;
    l->handle = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (!l->handle)
        return world_fail(m->world, "cannot load the simulated firmware: %s", dlerror());
    if (find_function(m, "sim_mcu_boot", &l->boot) || find_function(m, "sim_mcu_next_event", &l->next_event)
        || find_function(m, "sim_mcu_advance", &l->advance) || find_function(m, "sim_mcu_receive", &l->receive)
        || find_function(m, "sim_mcu_take_reset", &l->take_reset))
        return -1;
    find_optional(m, "emulator_load", &l->load_image);
    find_optional(m, "emulator_fault", &l->fault);
    m->board = (struct sim_board){
        .ctx = m,
        .pin_write = on_pin_write,
        .pin_read = on_pin_read,
        .pwm_write = on_pwm_write,
        .adc_read = on_adc_read,
        .bridge_set = on_bridge_set,
        .sync_adc_read = on_sync_adc_read,
        .sync_adc_move = on_sync_adc_move,
        .console_send = on_console_send,
        .spi_exchange = on_spi_exchange,
        .i2c_exchange = on_i2c_exchange,
    };
    return 0;
}

void world_mcu_unload(struct world_mcu *m)
{
    if (m->library.handle)
        dlclose(m->library.handle);
    m->library.handle = NULL;
}

/* ---- time ------------------------------------------------------------------------------------- */

double world_mcu_next_s(const struct world_mcu *m)
{
    uint64_t clock = m->library.next_event();
    if (clock == UINT64_MAX)
        return INFINITY;
    return fmax(to_seconds(m, clock), m->world->now_s);
}

static void reboot(struct world_mcu *m, uint64_t clock)
{
    machine_reset_outputs(&m->world->machine, m->index, to_seconds(m, clock));
    link_clear(&m->down);
    m->library.boot(&m->board, clock);
}

/* After every stretch of an MCU: has its model objected, does it want to be restarted? */
static void look_after(struct world_mcu *m, uint64_t clock)
{
    struct world *w = m->world;
    if (m->library.fault && !w->failed && m->library.fault(w->error, sizeof w->error))
        w->failed = 1;
    if (m->library.take_reset())
        reboot(m, clock);
}

void world_mcu_reboot(struct world_mcu *m)
{
    reboot(m, to_clock(m, m->world->now_s));
}

void world_mcu_advance(struct world_mcu *m, double until_s)
{
    uint64_t clock = to_clock(m, until_s);
    if (!m->booted) {
        m->booted = 1;
        m->library.boot(&m->board, clock);
    }
    if (m->library.next_event() > clock)
        return;
    m->library.advance(clock);
    look_after(m, clock);
}

void world_mcu_receive(struct world_mcu *m, const uint8_t *data, uint32_t length)
{
    uint64_t clock = to_clock(m, m->world->now_s);
    m->library.advance(clock);
    m->library.receive(data, length);
    m->library.advance(clock);
    look_after(m, clock);
}
