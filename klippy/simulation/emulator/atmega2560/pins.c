/* Digital pins, and the PWM outputs of timers 0 to 4. */
#include <string.h>

#include "chip.h"

/* Port numbers as in the firmware: A to L without I. */
static uint16_t
port_address(uint32_t port)
{
    return (uint16_t)(port < 7 ? REG_PINA + 3 * port : REG_PINH + 3 * (port - 7));
}

static uint32_t
port_of(uint16_t address)
{
    return address >= REG_PINH ? 7u + (address - REG_PINH) / 3u : (address - REG_PINA) / 3u;
}

static uint8_t
base_kind(uint16_t address)
{
    return (uint8_t)((address - (address >= REG_PINH ? REG_PINH : REG_PINA)) % 3);
}

/* Send the outputs whose level or direction has changed to the world. */
static void
change(uint16_t base, uint8_t direction, uint8_t level)
{
    uint8_t old_driven = chip->data[base + REG_DDR], old_level = chip->data[base + REG_PORT];
    uint8_t news = (uint8_t)((direction & ~old_driven) | (direction & (old_level ^ level)));
    /* an output let go floats to its pull-up */
    uint8_t let_go = (uint8_t)(old_driven & ~direction & level);
    chip->data[base + REG_DDR] = direction;
    chip->data[base + REG_PORT] = level;
    for (uint32_t bit = 0; bit < 8; bit++)
        if ((news | let_go) >> bit & 1)
            board.pin_write(board.ctx, port_of(base) * 8 + bit, level >> bit & 1, chip_clock());
}

static void
port_write(uint16_t address, uint8_t value)
{
    uint16_t base = (uint16_t)(address - base_kind(address));
    uint8_t direction = chip->data[base + REG_DDR], level = chip->data[base + REG_PORT];
    switch (base_kind(address)) {
    case 0:
        change(base, direction, level ^ value);
        break;
    case REG_DDR:
        change(base, value, level);
        break;
    default:
        change(base, direction, value);
    }
}

static uint8_t
port_read(uint16_t base)
{
    uint8_t direction = chip->data[base + REG_DDR], level = chip->data[base + REG_PORT] & direction;
    for (uint32_t bit = 0; bit < 8; bit++)
        if (!(direction >> bit & 1) && board.pin_read(board.ctx, port_of(base) * 8 + bit, chip_clock()))
            level |= (uint8_t)(1 << bit);
    return level;
}

void
pins_init(void)
{
    for (uint32_t port = 0; port < 11; port++) {
        uint16_t base = port_address(port);
        for (uint16_t i = 0; i < 3; i++)
            on_write(base + i, port_write);
        on_read(base, port_read);
    }
}

void
pins_reset(void)
{
}

/****************************************************************
 * PWM: phase correct, eight bits (datasheet chapters 16, 17, 20)
 ****************************************************************/

enum { PRR_TIM0 = 5, PRR_TIM1 = 3, PRR_TIM2 = 6, PRR1_TIM3 = 3, PRR1_TIM4 = 4 };

struct output {
    uint16_t control, compare, prr;
    uint8_t prr_bit, com_shift, pin;
};

static const struct output outputs[] = {
    { REG_TCCR0A, REG_OCR0A, REG_PRR0, PRR_TIM0, 6, 15 },  { REG_TCCR0A, REG_OCR0B, REG_PRR0, PRR_TIM0, 4, 53 },
    { REG_TCCR1A, 0x88, REG_PRR0, PRR_TIM1, 6, 13 },       { REG_TCCR1A, 0x8a, REG_PRR0, PRR_TIM1, 4, 14 },
    { REG_TCCR2A, REG_OCR2A, REG_PRR0, PRR_TIM2, 6, 12 },  { REG_TCCR2A, REG_OCR2B, REG_PRR0, PRR_TIM2, 4, 62 },
    { REG_TCCR3A, 0x98, REG_PRR1, PRR1_TIM3, 6, 35 },      { REG_TCCR3A, 0x9a, REG_PRR1, PRR1_TIM3, 4, 36 },
    { REG_TCCR3A, 0x9c, REG_PRR1, PRR1_TIM3, 2, 37 },      { REG_TCCR4A, 0xa8, REG_PRR1, PRR1_TIM4, 6, 59 },
    { REG_TCCR4A, 0xaa, REG_PRR1, PRR1_TIM4, 4, 60 },      { REG_TCCR4A, 0xac, REG_PRR1, PRR1_TIM4, 2, 61 },
};
enum { OUTPUTS = sizeof outputs / sizeof outputs[0], WGM_PHASE_CORRECT_8 = 1, COUNTS = 510, STARTED = 1 << 16 };

static uint32_t sent[OUTPUTS]; /* value and STARTED, as last sent to the world */

static uint32_t
divider(const struct output *o)
{
    static const uint16_t usual[] = { 0, 1, 8, 64, 256, 1024, 0, 0 }, of_timer2[] = { 0, 1, 8, 32, 64, 128, 256, 1024 };
    uint8_t select = chip->data[o->control + 1] & 7;
    return o->control == REG_TCCR2A ? of_timer2[select] : usual[select];
}

static void
pwm_look(void)
{
    for (unsigned i = 0; i < OUTPUTS; i++) {
        const struct output *o = &outputs[i];
        uint8_t com = chip->data[o->control] >> o->com_shift & 3, bit = o->pin % 8;
        uint32_t prescaler = divider(o);
        if (!com || !prescaler || !(chip->data[port_address(o->pin / 8u) + REG_DDR] >> bit & 1))
            continue;
        if ((chip->data[o->control] & 3) != WGM_PHASE_CORRECT_8 || chip->data[o->control + 1] & ~7 || com != 2)
            chip_fault("register 0x%02x: the model has 8-bit phase correct PWM only", o->control);
        uint32_t state = STARTED | chip->data[o->compare];
        if (state == sent[i])
            continue;
        sent[i] = state;
        board.pwm_write(board.ctx, o->pin, COUNTS * prescaler, chip->data[o->compare], chip_clock());
    }
}

static void
pwm_register_write(uint16_t address, uint8_t value)
{
    for (unsigned i = 0; i < OUTPUTS; i++)
        if (address == outputs[i].control || address == outputs[i].compare)
            need_power(outputs[i].prr, outputs[i].prr_bit, "timer of a PWM output");
    chip->data[address] = value;
    pwm_look();
}

static void
ddr_write(uint16_t address, uint8_t value)
{
    port_write(address, value);
    pwm_look();
}

void
pwm_init(void)
{
    for (unsigned i = 0; i < OUTPUTS; i++) {
        const struct output *o = &outputs[i];
        int wide = o->control != REG_TCCR0A && o->control != REG_TCCR2A;
        on_write(o->control, pwm_register_write);
        on_write(o->control + 1, pwm_register_write);
        on_write(o->compare, pwm_register_write);
        if (wide)
            on_write(o->compare + 1, write_plain);
        on_write(port_address(o->pin / 8u) + REG_DDR, ddr_write);
    }
}

void
pwm_reset(void)
{
    memset(sent, 0, sizeof sent);
}
