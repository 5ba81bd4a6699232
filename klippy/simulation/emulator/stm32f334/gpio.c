/* GPIO ports (RM0364 chapter 9), the pins' alternate functions (DS9994 tables 14 to 18 where a model needs them). */
#include "chip.h"

#include <string.h>

enum { MODER = 0x00, OTYPER = 0x04, OSPEEDR = 0x08, PUPDR = 0x0c, IDR = 0x10, ODR = 0x14, BSRR = 0x18, LCKR = 0x1c,
       AFRL = 0x20, AFRH = 0x24, BRR = 0x28, PORTS = 6, PINS = 16 };

static struct port {
    uint32_t mode, type, speed, pull, out, function[2];
    uint16_t sent, known; /* last level sent to the world, and whether any was */
    uint16_t peripheral;  /* level a peripheral drives on pins in alternate mode */
} ports[PORTS];

static unsigned mode_of(const struct port *p, unsigned i)
{
    return p->mode >> 2 * i & 3u;
}

unsigned gpio_mode(unsigned pin)
{
    return mode_of(&ports[pin / PINS], pin % PINS);
}

unsigned gpio_function(unsigned pin)
{
    const struct port *p = &ports[pin / PINS];
    unsigned i = pin % PINS;
    return mode_of(p, i) == MODE_ALTERNATE ? p->function[i / 8] >> 4 * (i % 8) & 15u : 99u;
}

unsigned gpio_pull(unsigned pin)
{
    return ports[pin / PINS].pull >> 2 * (pin % PINS) & 3u;
}

static void send(unsigned port, unsigned i, int level)
{
    struct port *p = &ports[port];
    uint16_t bit = (uint16_t)(1u << i);
    if (p->known & bit && !(p->sent & bit) == !level)
        return;
    p->known |= bit;
    p->sent = (uint16_t)(level ? p->sent | bit : p->sent & ~bit);
    board.pin_write(board.ctx, port * PINS + i, (uint8_t)level, now());
}

/* An open-drain output that is high lets its line go: to its pull-up. The world's lines have no other. */
static void send_outputs(unsigned port, uint32_t which)
{
    struct port *p = &ports[port];
    for (; which; which &= which - 1) {
        unsigned i = (unsigned)__builtin_ctz(which);
        if (mode_of(p, i) == MODE_OUTPUT)
            send(port, i, (int)(p->out >> i & 1u));
    }
}

void gpio_drive(unsigned pin, int level)
{
    send(pin / PINS, pin % PINS, level);
}

int gpio_level(unsigned pin)
{
    if (hrtim_is_fault_input(pin))
        return !mutation.fault_line;
    return board.pin_read(board.ctx, pin, now()) != 0;
}

static uint32_t idr_read(unsigned unit)
{
    const struct port *p = &ports[unit];
    uint32_t value = 0;
    for (unsigned i = 0; i < PINS; i++) {
        unsigned mode = mode_of(p, i);
        int open_high = mode == MODE_OUTPUT && p->type >> i & 1u && p->out >> i & 1u;
        if (mode == MODE_ANALOG)
            continue; /* reads as 0 (9.4.12) */
        if (mode == MODE_INPUT || mode == MODE_ALTERNATE || open_high)
            value |= (uint32_t)gpio_level(unit * PINS + i) << i;
        else
            value |= p->out & 1u << i;
    }
    return value;
}

uint32_t gpio_read(unsigned unit, uint32_t offset)
{
    const struct port *p = &ports[unit];
    switch (offset) {
    case MODER:
        return p->mode;
    case OTYPER:
        return p->type;
    case OSPEEDR:
        return p->speed;
    case PUPDR:
        return p->pull;
    case IDR:
        return idr_read(unit);
    case ODR:
        return p->out;
    case BSRR:
    case BRR:
        return 0;
    case AFRL:
    case AFRH:
        return p->function[(offset - AFRL) / 4];
    default:
        return unmodelled_read("GPIO", offset);
    }
}

static void set_outputs(unsigned unit, uint32_t value)
{
    uint32_t changed = (ports[unit].out ^ value) & 0xffffu;
    ports[unit].out = value & 0xffffu;
    send_outputs(unit, changed);
}

static void mode_write(unsigned unit, uint32_t value)
{
    struct port *p = &ports[unit];
    uint32_t changed = p->mode ^ value;
    /* PA13 and PA14 are the debugger's lines; turning them into something else locks it out. That is allowed. */
    p->mode = value;
    for (unsigned i = 0; i < PINS; i++) {
        if (!(changed >> 2 * i & 3u))
            continue;
        unsigned mode = mode_of(p, i);
        if (mode == MODE_OUTPUT)
            send(unit, i, (int)(p->out >> i & 1u));
        else if (mode == MODE_INPUT && (p->pull >> 2 * i & 3u) == 1 && p->known >> i & 1u)
            send(unit, i, 1); /* let go: its pull-up takes it */
        timer_pin_changed(unit * PINS + i);
    }
}

void gpio_write(unsigned unit, uint32_t offset, uint32_t value)
{
    struct port *p = &ports[unit];
    unsigned narrow = offset >> 28;
    offset &= 0xfffu;
    if (narrow && !(narrow == 2 && (offset == ODR || offset == BSRR || offset == BSRR + 2 || offset == BRR))) {
        fault("a write of %u bytes to GPIO + 0x%02x", narrow, offset);
        return;
    }
    switch (offset) {
    case MODER:
        mode_write(unit, value);
        return;
    case OTYPER:
        p->type = value & 0xffffu;
        return;
    case OSPEEDR:
        p->speed = value;
        return;
    case PUPDR:
        p->pull = value;
        return;
    case ODR:
        set_outputs(unit, value);
        return;
    case BSRR:
        set_outputs(unit, (p->out & ~(value >> 16)) | (value & 0xffffu)); /* set wins (9.4.7) */
        return;
    case BSRR + 2:
        set_outputs(unit, p->out & ~value);
        return;
    case BRR:
        set_outputs(unit, p->out & ~value);
        return;
    case AFRL:
    case AFRH:
        p->function[(offset - AFRL) / 4] = value;
        return;
    default:
        unmodelled_write("GPIO", offset, value);
    }
}

/* Reset state (9.4): all analog or input; port A's debugger pins in alternate mode. The world gets no report: whoever
 * restarts the chip switches off what it drives. */
void gpio_reset(unsigned unit)
{
    struct port *p = &ports[unit];
    memset(p, 0, sizeof *p);
    if (unit == 0) {
        p->mode = 0xa8000000u;
        p->speed = 0x0c000000u;
        p->pull = 0x64000000u;
    } else if (unit == 1) {
        p->mode = 0x280u;
        p->speed = 0xc0u;
        p->pull = 0x100u;
    }
}
