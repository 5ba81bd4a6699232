/* Displays: what their chips are sent, byte by byte. What the bytes mean is decided elsewhere (klippy/simulation/panel/).
 *
 *   serial     a bit of data[0] at each rising edge of clock while selected; or whole bytes of a hardware bus
 *   parallel   the four data lines at each falling edge of clock (E)
 *   I2C        the bytes written to the address
 */
#include "machine.h"

/* Makes a line the panel's; one that is not connected is left out. */
static int claim(struct machine *m, struct world_pin p, int panel, uint8_t idle)
{
    if (p.mcu < 0)
        return 0;
    if (p.mcu >= MACHINE_MCUS || p.pin < 0 || p.pin >= MACHINE_PINS)
        return -1;
    struct machine_pin *pin = &m->pins[p.mcu][p.pin];
    if (pin->role != PIN_UNUSED)
        return -1;
    *pin = (struct machine_pin){ .role = PIN_PANEL, .target = (uint8_t)panel, .level = idle };
    return 0;
}

int machine_add_panel(struct machine *m, const struct world_panel_options *o)
{
    int index = m->panel_count;
    if (index == MACHINE_PANELS)
        return -1;
    int failed = claim(m, o->select, index, o->select.inverted != 0) || claim(m, o->clock, index, 0)
                 || claim(m, o->is_data, index, 0) || claim(m, o->reset, index, 1);
    for (int line = 0; line < WORLD_PANEL_LINES; line++)
        failed = failed || claim(m, o->data[line], index, 0);
    if (failed)
        return -1;
    m->panels[index] = (struct panel){ .options = *o };
    return m->panel_count++;
}

int machine_set_input(struct machine *m, struct world_pin p, int level)
{
    if (p.mcu < 0 || p.mcu >= MACHINE_MCUS || p.pin < 0 || p.pin >= MACHINE_PINS
        || m->pins[p.mcu][p.pin].role != PIN_UNUSED)
        return -1;
    m->pins[p.mcu][p.pin].level = level != 0;
    return 0;
}

uint32_t machine_read_panel(struct machine *m, int panel, uint16_t *out, uint32_t capacity)
{
    struct panel *p = &m->panels[panel];
    uint32_t count = 0;
    for (; p->count && count < capacity; p->count--, p->first = (p->first + 1) % MACHINE_PANEL_EVENTS)
        out[count++] = p->events[p->first];
    return count;
}

static int level_of(const struct machine *m, struct world_pin p)
{
    return p.mcu >= 0 && m->pins[p.mcu][p.pin].level != (p.inverted != 0);
}

static void note(struct panel *p, int event, unsigned value)
{
    if (p->count == MACHINE_PANEL_EVENTS)
        p->lost = 1;
    else
        p->events[(p->first + p->count++) % MACHINE_PANEL_EVENTS] = (uint16_t)(event << 12 | value);
}

static unsigned data_flag(const struct machine *m, const struct panel *p)
{
    return level_of(m, p->options.is_data) ? 0x100u : 0u;
}

static void clock_edge(const struct machine *m, struct panel *p, int is_rising)
{
    const struct world_panel_options *o = &p->options;
    if (o->bus == WORLD_PANEL_PARALLEL && !is_rising) {
        unsigned half = 0;
        for (int line = 0; line < WORLD_PANEL_LINES; line++)
            half |= (unsigned)level_of(m, o->data[line]) << line;
        note(p, WORLD_PANEL_BYTE, half | data_flag(m, p));
    } else if (o->bus == WORLD_PANEL_SERIAL && is_rising && level_of(m, o->select)) {
        p->shift = (uint8_t)(p->shift << 1 | level_of(m, o->data[0]));
        if (++p->bits == 8) {
            p->bits = 0;
            note(p, WORLD_PANEL_BYTE, p->shift | data_flag(m, p));
        }
    }
}

static int is_pin(struct world_pin p, int mcu, uint32_t number)
{
    return p.mcu == mcu && (uint32_t)p.pin == number;
}

void panel_pin_changed(const struct machine *m, struct panel *p, int mcu, uint32_t number, uint8_t value)
{
    const struct world_panel_options *o = &p->options;
    if (is_pin(o->clock, mcu, number))
        clock_edge(m, p, value);
    else if (is_pin(o->select, mcu, number)) {
        p->bits = 0;
        note(p, level_of(m, o->select) ? WORLD_PANEL_SELECTED : WORLD_PANEL_RELEASED, 0);
    } else if (is_pin(o->reset, mcu, number) && !value)
        note(p, WORLD_PANEL_RESET, 0);
}

void panels_spi(struct machine *m, int mcu, const uint8_t *data, uint32_t len)
{
    for (int i = 0; i < m->panel_count; i++) {
        struct panel *p = &m->panels[i];
        if (p->options.bus != WORLD_PANEL_SERIAL || p->options.select.mcu != mcu || !level_of(m, p->options.select))
            continue;
        for (uint32_t k = 0; k < len; k++)
            note(p, WORLD_PANEL_BYTE, data[k] | data_flag(m, p));
    }
}

int panels_i2c(struct machine *m, int mcu, uint8_t address, const uint8_t *write, uint32_t write_len)
{
    for (int i = 0; i < m->panel_count; i++) {
        struct panel *p = &m->panels[i];
        if (p->options.bus != WORLD_PANEL_I2C || p->options.i2c_mcu != mcu || p->options.i2c_address != address)
            continue;
        note(p, WORLD_PANEL_SELECTED, 0);
        for (uint32_t k = 0; k < write_len; k++)
            note(p, WORLD_PANEL_BYTE, write[k]);
        note(p, WORLD_PANEL_RELEASED, 0);
        return 1;
    }
    return 0;
}
