/* DMA1 (RM0364 chapter 11): seven channels, transfers to and from peripherals. */
#include "chip.h"

#include <string.h>

enum {
    CHANNELS = 7, EN = 1u << 0, TCIE = 1u << 1, HTIE = 1u << 2, TEIE = 1u << 3, DIR = 1u << 4, CIRC = 1u << 5,
    PINC = 1u << 6, MINC = 1u << 7, MEM2MEM = 1u << 14, TCIF = 2, HTIF = 4,
};

static struct channel {
    uint32_t ccr, cndtr, cpar, cmar, left;
} channels[CHANNELS];
static uint32_t flags; /* four bits a channel */

static void update_line(unsigned i)
{
    uint32_t f = flags >> 4 * i;
    nvic_line(IRQ_DMA1 + i, (f & TCIF && channels[i].ccr & TCIE) || (f & HTIF && channels[i].ccr & HTIE));
}

static void raise(unsigned i, uint32_t flag)
{
    flags |= (flag | 1u) << 4 * i;
    update_line(i);
}

int dma_enabled(unsigned channel)
{
    return (channels[channel - 1].ccr & EN) && !(mutation.dma_dead >> (channel - 1) & 1u);
}

uint32_t dma_peripheral_address(unsigned channel)
{
    return channels[channel - 1].cpar;
}

static uint32_t half_of(const struct channel *c)
{
    return c->cndtr / 2;
}

uint32_t dma_until_notice(unsigned channel)
{
    const struct channel *c = &channels[channel - 1];
    return c->left > half_of(c) ? c->left - half_of(c) : c->left;
}

static void count_down(unsigned i, uint32_t by)
{
    struct channel *c = &channels[i];
    uint32_t before = c->left;
    c->left -= by;
    if (before > half_of(c) && c->left <= half_of(c))
        raise(i, HTIF);
    if (c->left)
        return;
    raise(i, TCIF);
    if (c->ccr & CIRC)
        c->left = c->cndtr;
}

int dma_request(unsigned channel)
{
    unsigned i = channel - 1;
    struct channel *c = &channels[i];
    if (!dma_enabled(channel) || !c->left)
        return -1;
    uint32_t done = c->cndtr - c->left, value = 0;
    unsigned psize = 1u << (c->ccr >> 8 & 3u), msize = 1u << (c->ccr >> 10 & 3u);
    uint32_t memory = c->cmar + (c->ccr & MINC ? done * msize : 0);
    uint32_t peripheral = c->cpar + (c->ccr & PINC ? done * psize : 0);
    int bad;
    c->left--; /* a peripheral may ask again from within the access */
    if (c->ccr & DIR) {
        bad = memory_read(memory, &value, msize);
        chip_write(peripheral, psize == 4 ? value : value & ((1u << 8 * psize) - 1u), psize);
    } else {
        value = chip_read(peripheral, psize);
        bad = memory_write(memory, &value, msize);
    }
    c->left++;
    if (bad)
        fault("DMA1 channel %u: 0x%08x is no memory it reaches", channel, memory);
    count_down(i, 1);
    return 0;
}

void dma_block(unsigned channel, const uint16_t *data, uint32_t count)
{
    unsigned i = channel - 1;
    struct channel *c = &channels[i];
    while (count && c->left) {
        uint32_t part = dma_until_notice(channel);
        part = part < count ? part : count;
        uint32_t at = c->cmar + 2 * (c->cndtr - c->left);
        if (memory_write(at, data, 2 * part))
            fault("DMA1 channel %u: 0x%08x is no memory it reaches", channel, at);
        count_down(i, part);
        data += part;
        count -= part;
    }
}

uint32_t dma_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    if (offset == 0x00) {
        adc_sync();
        return flags;
    }
    if (offset == 0x04)
        return 0;
    unsigned i = (offset - 8) / 20;
    if (offset < 8 || i >= CHANNELS)
        return unmodelled_read("DMA1", offset);
    switch ((offset - 8) % 20) {
    case 0:
        return channels[i].ccr;
    case 4:
        adc_sync();
        return channels[i].ccr & EN ? channels[i].left : channels[i].cndtr;
    case 8:
        return channels[i].cpar;
    case 12:
        return channels[i].cmar;
    default:
        return unmodelled_read("DMA1", offset);
    }
}

static int in_sram(uint32_t address)
{
    return address >= 0x20000000u && address < 0x20003000u;
}

static void switch_on(unsigned i)
{
    struct channel *c = &channels[i];
    if (c->ccr & MEM2MEM)
        fault("DMA1 channel %u: memory to memory is not modelled", i + 1);
    if (!c->cndtr)
        fault("DMA1 channel %u is switched on with nothing to transfer", i + 1);
    if (c->cmar >> 12 == 0x10000u)
        fault("DMA1 channel %u points into the CCM (0x%08x), which DMA cannot reach (RM0364, 3.1)", i + 1, c->cmar);
    else if (!in_sram(c->cmar) && !(c->ccr & DIR && c->cmar >> 16 == 0x0800u))
        fault("DMA1 channel %u: memory address 0x%08x", i + 1, c->cmar);
    unsigned msize = 1u << (c->ccr >> 10 & 3u);
    if (c->cmar & (msize - 1u))
        fault("DMA1 channel %u: memory address 0x%08x is not aligned", i + 1, c->cmar);
    c->left = c->cndtr;
}

static void ccr_write(unsigned i, uint32_t value)
{
    struct channel *c = &channels[i];
    adc_sync();
    must_be("DMA1", "CCR", value, 0x7fffu);
    int on = value & EN && !(c->ccr & EN);
    if (value & EN && c->ccr & EN && (value ^ c->ccr) & ~(uint32_t)(TCIE | HTIE | TEIE))
        fault("DMA1 channel %u is changed while it is on (CCR 0x%x to 0x%x)", i + 1, c->ccr, value);
    if (!(value & EN) && c->ccr & EN)
        c->cndtr = c->left; /* the register shows what is left */
    c->ccr = value;
    if (on)
        switch_on(i);
    update_line(i);
    adc_dma_changed();
    if (on)
        usart_dma_enabled(i + 1);
}

void dma_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    if (offset == 0x04) {
        for (unsigned i = 0; i < CHANNELS; i++) {
            uint32_t f = value >> 4 * i & 15u;
            flags &= ~((f & 1u ? 15u : f) << 4 * i);
            if (!(flags >> 4 * i & 14u))
                flags &= ~(1u << 4 * i);
            update_line(i);
        }
        return;
    }
    unsigned i = (offset - 8) / 20, reg = (offset - 8) % 20;
    if (offset < 8 || i >= CHANNELS || reg > 12) {
        unmodelled_write("DMA1", offset, value);
        return;
    }
    if (reg && channels[i].ccr & EN) {
        fault("DMA1 channel %u: + 0x%02x is written while the channel is on", i + 1, offset);
        return;
    }
    if (reg == 0)
        ccr_write(i, value);
    else if (reg == 4)
        channels[i].cndtr = value & 0xffffu;
    else if (reg == 8)
        channels[i].cpar = value;
    else
        channels[i].cmar = value;
}

void dma_reset(unsigned unit)
{
    (void)unit;
    memset(channels, 0, sizeof channels);
    flags = 0;
}
