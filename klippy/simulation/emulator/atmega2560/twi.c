/* The TWI as an I2C master, polled (datasheet chapter 24).  A transfer meets the world when its reading half begins, or whole
 * when it ends; the model asks for READ_AHEAD bytes then, because the chip's master knows only with each byte whether
 * it wants another.
 */
#include <string.h>

#include "chip.h"

enum {
    TWINT = 1 << 7, TWEA = 1 << 6, TWSTA = 1 << 5, TWSTO = 1 << 4, TWEN = 1 << 2, TWIE = 1 << 0, PRESCALER = 3, PRTWI = 7,
    SCL_MAX_HZ = 400000, BYTES = 128, READ_AHEAD = 64,
};
/* TWSR, tables 24-3 and 24-4 */
enum {
    STARTED = 0x08, STARTED_AGAIN = 0x10, WRITE_ACK = 0x18, WRITE_NACK = 0x20, DATA_ACK = 0x28, READ_ACK = 0x40,
    READ_NACK = 0x48, GOT_ACK = 0x50, GOT_NACK = 0x58, NOTHING = 0xf8,
};
enum phase { IDLE, ADDRESS, WRITING, READING, REFUSED };

static struct {
    enum phase phase;
    uint8_t status;            /* when the step under way has ended */
    uint8_t address, out[BYTES], in[BYTES];
    unsigned out_count, in_read;
} twi;

static uint64_t
bit_cycles(void)
{
    return 16 + 2ull * chip->data[REG_TWBR] * (1u << 2 * (chip->data[REG_TWSR] & PRESCALER));
}

static int
exchange(unsigned write, unsigned read)
{
    if (!board.i2c_exchange)
        return 1;
    return board.i2c_exchange(board.ctx, 0, twi.address, twi.out, write, twi.in, read, chip_clock());
}

static avr_cycle_count_t
step_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)when;
    (void)param;
    chip->data[REG_TWSR] = (uint8_t)(twi.status | (chip->data[REG_TWSR] & PRESCALER));
    chip->data[REG_TWCR] |= TWINT;
    return 0;
}

static avr_cycle_count_t
stop_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)when;
    (void)param;
    if (twi.phase == WRITING && twi.out_count)
        exchange(twi.out_count, 0);
    twi.phase = IDLE;
    twi.out_count = 0;
    chip->data[REG_TWSR] = (uint8_t)(NOTHING | (chip->data[REG_TWSR] & PRESCALER));
    chip->data[REG_TWCR] &= (uint8_t)~TWSTO;
    return 0;
}

static uint8_t
take_address(uint8_t byte)
{
    twi.address = byte >> 1;
    int absent = exchange(byte & 1 ? twi.out_count : 0, byte & 1 ? READ_AHEAD : 0);
    twi.in_read = 0;
    if (byte & 1)
        twi.out_count = 0;
    twi.phase = absent ? REFUSED : byte & 1 ? READING : WRITING;
    if (byte & 1)
        return absent ? READ_NACK : READ_ACK;
    return absent ? WRITE_NACK : WRITE_ACK;
}

static uint8_t
next_byte(uint8_t control)
{
    switch (twi.phase) {
    case ADDRESS:
        return take_address(chip->data[REG_TWDR]);
    case WRITING:
        if (twi.out_count < BYTES)
            twi.out[twi.out_count++] = chip->data[REG_TWDR];
        return DATA_ACK;
    case READING:
        chip->data[REG_TWDR] = twi.in_read < READ_AHEAD ? twi.in[twi.in_read++] : 0xff;
        return control & TWEA ? GOT_ACK : GOT_NACK;
    default:
        chip_fault("the TWI is to move a byte before a start, or after nobody has answered");
        return NOTHING;
    }
}

static void
control_write(uint8_t value)
{
    uint32_t rate = (uint32_t)(CLOCK_HZ / bit_cycles());
    if (value & TWIE)
        chip_fault("TWCR 0x%02x: the model has no TWI interrupt", value);
    if (!(value & TWEN)) {
        twi_reset();
        return;
    }
    if (!(value & TWINT)) { /* nothing begins before the flag is cleared */
        chip->data[REG_TWCR] = (uint8_t)(value | (chip->data[REG_TWCR] & TWINT));
        return;
    }
    chip->data[REG_TWCR] = value & (uint8_t)~TWINT;
    if (rate > SCL_MAX_HZ)
        chip_fault("the TWI's clock runs at %u Hz; the maximum is 400000", rate);
    if (value & TWSTO) {
        after(bit_cycles(), stop_done);
    } else if (value & TWSTA) {
        twi.status = twi.phase == IDLE ? STARTED : STARTED_AGAIN;
        twi.phase = ADDRESS;
        after(bit_cycles(), step_done);
    } else {
        twi.status = next_byte(value);
        after(9 * bit_cycles(), step_done);
    }
}

static void
twi_write(uint16_t address, uint8_t value)
{
    need_power(REG_PRR0, PRTWI, "TWI");
    if (address == REG_TWCR)
        control_write(value);
    else if (address == REG_TWSR)
        chip->data[address] = (uint8_t)((chip->data[address] & ~PRESCALER) | (value & PRESCALER));
    else
        chip->data[address] = value;
}

void
twi_init(void)
{
    on_write(REG_TWBR, twi_write);
    on_write(REG_TWSR, twi_write);
    on_write(REG_TWDR, twi_write);
    on_write(REG_TWCR, twi_write);
}

void
twi_reset(void)
{
    memset(&twi, 0, sizeof twi);
    chip->data[REG_TWCR] = 0;
    chip->data[REG_TWSR] = NOTHING;
    chip->data[REG_TWDR] = 0xff;
    avr_cycle_timer_cancel(chip, step_done, NULL);
    avr_cycle_timer_cancel(chip, stop_done, NULL);
}
