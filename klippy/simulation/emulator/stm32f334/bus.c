/* SPI1 and I2C1 as masters (RM0364 chapters 28 and 26), polled. A byte on SPI meets the world when it has been shifted; an I2C
 * transfer meets it whole, when its last byte has been written or its reading half begins.
 */
#include "chip.h"

#include <string.h>

/* ---- SPI ------------------------------------------------------------------------------------------------------ */

enum { S_CR1 = 0x00, S_CR2 = 0x04, S_SR = 0x08, S_DR = 0x0c, S_I2SCFGR = 0x1c, SPE = 1u << 6, MSTR = 1u << 2, FIFO = 4 };

static struct {
    uint32_t cr1, cr2;
    uint8_t out[FIFO], in[FIFO], shifting;
    unsigned out_count, in_count, busy, overrun;
    struct event shifted;
} spi;

static uint64_t spi_byte_ticks(void)
{
    return (uint64_t)ticks_of(8u * (2u << (spi.cr1 >> 3 & 7u)), clocks.pclk2);
}

static int spi_pins(void)
{
    /* SCK, MOSI in alternate function 5: PA5 PA7, PB3 PB5 (DS9994) */
    return (gpio_function(5) == 5 && gpio_function(7) == 5) || (gpio_function(19) == 5 && gpio_function(21) == 5);
}

static void shift_next(void)
{
    if (spi.busy || !spi.out_count)
        return;
    spi.shifting = spi.out[0];
    memmove(spi.out, spi.out + 1, --spi.out_count);
    spi.busy = 1;
    event_at(&spi.shifted, now() + spi_byte_ticks());
}

static void shifted(void *arg)
{
    (void)arg;
    uint8_t byte = spi.shifting;
    if (board.spi_exchange)
        board.spi_exchange(board.ctx, 0, (uint8_t)((spi.cr1 & 2u) | (spi.cr1 & 1u)), &byte, 1, now());
    else
        byte = 0xff;
    if (spi.in_count < FIFO)
        spi.in[spi.in_count++] = byte;
    else
        spi.overrun = 1;
    spi.busy = 0;
    shift_next();
}

uint32_t spi_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    uint32_t value = 0;
    switch (offset) {
    case S_CR1:
        return spi.cr1;
    case S_CR2:
        return spi.cr2;
    case S_SR:
        return (spi.in_count ? 1u : 0) | (spi.out_count < FIFO / 2 ? 2u : 0) | spi.overrun << 6
               | (spi.busy || spi.out_count ? 1u << 7 : 0) | (spi.in_count > 3 ? 3u : spi.in_count) << 9
               | (spi.out_count > 3 ? 3u : spi.out_count) << 11;
    case S_DR:
        if (spi.in_count) {
            value = spi.in[0];
            memmove(spi.in, spi.in + 1, --spi.in_count);
        }
        return value;
    case S_I2SCFGR:
        return 0;
    default:
        return unmodelled_read("SPI1", offset);
    }
}

static void data_write(unsigned narrow, uint32_t value)
{
    if (!(spi.cr1 & SPE) || !(spi.cr1 & MSTR))
        fault("SPI1_DR is written while the SPI is off or no master (CR1 = 0x%x)", spi.cr1);
    if (narrow != 1)
        fault("SPI1_DR takes bytes here: a wider write packs two frames (RM0364, 28.5.9)");
    if (!(spi.cr2 & 1u << 12))
        fault("SPI1 with 8-bit frames needs FRXTH = 1 to see single bytes (CR2 = 0x%x)", spi.cr2);
    if (!spi_pins())
        fault("SPI1 sends, and its SCK and MOSI pins are not in alternate function 5");
    if (spi.out_count == FIFO)
        fault("SPI1_DR is written while its FIFO is full");
    else
        spi.out[spi.out_count++] = (uint8_t)value;
    shift_next();
}

void spi_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    unsigned narrow = offset >> 28;
    switch (offset & 0xfffu) {
    case S_CR1:
        must_be("SPI1", "CR1", value, 0x37fu);
        if (spi.cr1 & SPE && (value ^ spi.cr1) & 0x3bu)
            fault("SPI1: clock or mode are changed while it is on (CR1 0x%x to 0x%x)", spi.cr1, value);
        if (value & SPE && value & MSTR && !(value & 1u << 8) && value & 1u << 9)
            fault("SPI1: SSM with SSI = 0 makes a master fault (RM0364, 28.5.5)");
        spi.cr1 = value;
        return;
    case S_CR2:
        must_be("SPI1", "CR2", value, 0x1f04u);
        if (value >> 8 & 15u && (value >> 8 & 15u) != 7u)
            fault("SPI1: frames of other than 8 bits are not modelled (CR2 = 0x%x)", value);
        spi.cr2 = value;
        return;
    case S_SR:
        return;
    case S_DR:
        data_write(narrow, value);
        return;
    default:
        if (value || (offset & 0xfffu) != S_I2SCFGR)
            unmodelled_write("SPI1", offset & 0xfffu, value);
    }
}

void spi_reset(unsigned unit)
{
    (void)unit;
    struct event kept = spi.shifted;
    memset(&spi, 0, sizeof spi);
    spi.cr2 = 0x700u;
    spi.shifted = kept;
    spi.shifted.run = shifted;
    event_at(&spi.shifted, NEVER);
}

/* ---- I2C ------------------------------------------------------------------------------------------------------- */

enum {
    I_CR1 = 0x00, I_CR2 = 0x04, I_TIMINGR = 0x10, I_TIMEOUTR = 0x14, I_ISR = 0x18, I_ICR = 0x1c, I_RXDR = 0x24, I_TXDR = 0x28,
    TXE = 1u << 0, TXIS = 1u << 1, RXNE = 1u << 2, NACKF = 1u << 4, STOPF = 1u << 5, TC = 1u << 6, BUSY = 1u << 15,
    START = 1u << 13, STOP = 1u << 14, READ = 1u << 10, AUTOEND = 1u << 25, BYTES = 256,
};

static struct {
    uint32_t cr1, cr2, timing, isr, txdr, rxdr;
    uint8_t out[BYTES], in[BYTES];
    unsigned out_count, in_count, in_read, left;
    int reading, sent;
    struct event byte;
} i2c;

static uint64_t i2c_byte_ticks(void)
{
    uint32_t hz = 8000000; /* HSI unless RCC_CFGR3.I2C1SW */
    if (rcc_read(0, 0x30) & 1u << 4)
        hz = clocks.hclk;
    uint32_t prescaler = (i2c.timing >> 28) + 1, low = (i2c.timing & 0xffu) + 1, high = (i2c.timing >> 8 & 0xffu) + 1;
    return (uint64_t)ticks_of(9 * prescaler * (low + high), hz) + 1;
}

static uint8_t exchange(unsigned read)
{
    if (!board.i2c_exchange)
        return 3;
    return board.i2c_exchange(board.ctx, 0, (uint8_t)(i2c.cr2 >> 1 & 0x7fu), i2c.out, i2c.out_count, i2c.in, read, now());
}

static void finish(void)
{
    if (!i2c.reading && i2c.out_count && !i2c.sent)
        exchange(0);
    i2c.sent = 1;
    i2c.isr = (i2c.isr & ~(uint32_t)(BUSY | TC | TXIS)) | STOPF;
    i2c.out_count = 0;
}

static void refuse(void)
{
    i2c.isr |= NACKF;
    i2c.sent = 1;
    finish(); /* a master that is not acknowledged sends a stop by itself (26.4.8) */
}

/* A byte, or the address, has crossed the bus. */
static void byte_done(void *arg)
{
    (void)arg;
    if (i2c.reading) {
        i2c.rxdr = i2c.in[i2c.in_read++];
        i2c.isr |= RXNE;
        i2c.left--;
        return; /* the next byte is clocked when this one has been read */
    }
    if (i2c.left)
        i2c.isr |= TXIS | TXE;
    else if (i2c.cr2 & AUTOEND)
        finish();
    else
        i2c.isr |= TC;
}

static void start(void)
{
    if (!(i2c.cr1 & 1u))
        fault("I2C1: START while the peripheral is off");
    i2c.left = i2c.cr2 >> 16 & 0xffu;
    i2c.isr = (i2c.isr & ~(uint32_t)(TC | NACKF | STOPF)) | BUSY;
    i2c.reading = (i2c.cr2 & READ) != 0;
    i2c.in_read = 0;
    i2c.sent = 0;
    uint8_t status;
    if (i2c.reading) {
        status = exchange(i2c.left);
        i2c.out_count = 0;
    } else {
        i2c.out_count = 0;
        status = exchange(0); /* is anybody there? */
    }
    if (status)
        refuse();
    else
        event_at(&i2c.byte, now() + i2c_byte_ticks() * (i2c.reading && i2c.left ? 2 : 1));
}

uint32_t i2c_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    switch (offset) {
    case I_CR1:
        return i2c.cr1;
    case I_CR2:
        return i2c.cr2 & ~(uint32_t)(START | STOP);
    case I_TIMINGR:
        return i2c.timing;
    case I_ISR:
        return i2c.isr;
    case I_RXDR:
        i2c.isr &= ~(uint32_t)RXNE;
        if (i2c.left)
            event_at(&i2c.byte, now() + i2c_byte_ticks());
        else if (i2c.cr2 & AUTOEND)
            finish();
        else
            i2c.isr |= TC;
        return i2c.rxdr;
    default:
        return unmodelled_read("I2C1", offset);
    }
}

static void tx_write(uint32_t value)
{
    if (!(i2c.isr & TXIS)) {
        fault("I2C1_TXDR is written while it is not asked for (ISR = 0x%x)", i2c.isr);
        return;
    }
    i2c.isr &= ~(uint32_t)(TXIS | TXE);
    if (i2c.out_count < BYTES)
        i2c.out[i2c.out_count++] = (uint8_t)value;
    i2c.left--;
    event_at(&i2c.byte, now() + i2c_byte_ticks());
}

void i2c_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    switch (offset) {
    case I_CR1:
        must_be("I2C1", "CR1", value, 0x1f01u);
        i2c.cr1 = value;
        if (!(value & 1u)) {
            i2c.isr = TXE;
            event_at(&i2c.byte, NEVER);
        }
        return;
    case I_CR2:
        i2c.cr2 = value;
        if (value & START)
            start();
        else if (value & STOP)
            finish();
        return;
    case I_TIMINGR:
        if (i2c.cr1 & 1u)
            fault("I2C1_TIMINGR is written while the peripheral is on (RM0364, 26.7.5)");
        i2c.timing = value;
        return;
    case I_ICR:
        i2c.isr &= ~(value & 0x3f38u);
        return;
    case I_TXDR:
        tx_write(value);
        return;
    case I_ISR:
        return; /* flushing TXE */
    default:
        if (value || offset > I_TIMEOUTR)
            unmodelled_write("I2C1", offset, value);
    }
}

void i2c_reset(unsigned unit)
{
    (void)unit;
    struct event kept = i2c.byte;
    memset(&i2c, 0, sizeof i2c);
    i2c.isr = TXE;
    i2c.byte = kept;
    i2c.byte.run = byte_done;
    event_at(&i2c.byte, NEVER);
}
