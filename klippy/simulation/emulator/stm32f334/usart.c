/* USART1..3 (RM0364 chapter 27), asynchronous, 8 data bits, as the console. */
#include "chip.h"

#include <string.h>

enum {
    CR1 = 0x00, CR2 = 0x04, CR3 = 0x08, BRR = 0x0c, RTOR = 0x14, RQR = 0x18, ISR = 0x1c, ICR = 0x20, RDR = 0x24, TDR = 0x28,
    UE = 1u << 0, RE = 1u << 2, TE = 1u << 3, IDLEIE = 1u << 4, RXNEIE = 1u << 5, TCIE = 1u << 6, TXEIE = 1u << 7,
    CMIE = 1u << 14,
    ORE = 1u << 3, IDLE = 1u << 4, RXNE = 1u << 5, TC = 1u << 6, TXE = 1u << 7, CMF = 1u << 17, TEACK = 1u << 21, REACK = 1u << 22,
    EIE = 1u << 0, DMAR = 1u << 6, DMAT = 1u << 7, OVRDIS = 1u << 12,
    UNITS = 3, WIRE = 4096, BATCH = 64, BITS = 10,
};

static struct usart {
    uint32_t cr1, cr2, cr3, brr, isr, rdr, tdr;
    struct event receive, transmit;
    double next_receive, next_transmit; /* ticks, unrounded */
    uint8_t wire[WIRE];  /* bytes on their way in */
    uint32_t wire_first, wire_count;
    uint8_t batch[BATCH]; /* bytes transmitted, not yet sent to the world */
    uint32_t batch_count;
    uint8_t shifting, shift_full, last_idle;
} usarts[UNITS];

static const struct { const char *name; unsigned irq, dma_tx, dma_rx, tx[4], rx[4]; } FIXED[UNITS] = {
    /* pins in alternate function 7: PA9 PB6 PC4, PA10 PB7 PC5; PA2 PB3 PA14, PA3 PB4 PA15; PB10 PC10, PB11 PC11 */
    { "USART1", IRQ_USART1, 4, 5, { 9, 22, 36, 999 }, { 10, 23, 37, 999 } },
    { "USART2", IRQ_USART2, 7, 6, { 2, 19, 14, 999 }, { 3, 20, 15, 999 } },
    { "USART3", IRQ_USART3, 2, 3, { 26, 42, 999, 999 }, { 27, 43, 999, 999 } },
};

static int on_pin(const unsigned *pins)
{
    for (; *pins != 999; pins++)
        if (gpio_function(*pins) == 7)
            return 1;
    return 0;
}

static void update_line(unsigned unit)
{
    struct usart *u = &usarts[unit];
    int line = (u->cr1 & TXEIE && u->isr & TXE) || (u->cr1 & TCIE && u->isr & TC)
               || (u->cr1 & RXNEIE && u->isr & (RXNE | ORE)) || (u->cr1 & IDLEIE && u->isr & IDLE)
               || (u->cr1 & CMIE && u->isr & CMF) || (u->cr3 & EIE && u->isr & ORE);
    nvic_line(FIXED[unit].irq, line);
}

static double byte_ticks(unsigned unit)
{
    const struct usart *u = &usarts[unit];
    uint32_t clock = unit == 0 ? clocks.usart1 : clocks.pclk1;
    double divider = u->cr1 & 1u << 15 ? ((u->brr & 0xfff0u) | (u->brr & 7u) << 1) / 2.0 : u->brr;
    return BITS * divider * CORE_TICK_HZ / clock;
}

/* ---- out ------------------------------------------------------------------------------------------ */

static void flush(struct usart *u)
{
    if (u->batch_count)
        board.console_send(board.ctx, u->batch, u->batch_count, now());
    u->batch_count = 0;
}

static void load_shifter(unsigned unit)
{
    struct usart *u = &usarts[unit];
    if (!on_pin(FIXED[unit].tx))
        fault("%s sends, and none of its TX pins is in alternate function 7", FIXED[unit].name);
    u->shifting = (uint8_t)u->tdr;
    u->shift_full = 1;
    u->isr = (u->isr | TXE) & ~TC;
    double start = u->next_transmit > (double)now() ? u->next_transmit : (double)now();
    u->next_transmit = start + byte_ticks(unit);
    event_at(&u->transmit, (uint64_t)u->next_transmit);
    if (u->cr3 & DMAT && dma_enabled(FIXED[unit].dma_tx))
        dma_request(FIXED[unit].dma_tx);
}

/* The world hears of bytes at the end of a message (0x7e) or when the line falls silent: it looks at whole messages only,
 * so this costs no time that anybody could notice. */
static void byte_out(void *arg)
{
    struct usart *u = arg;
    unsigned unit = (unsigned)(u - usarts);
    uint8_t byte = u->shifting;
    u->batch[u->batch_count++] = byte;
    counters.console_bytes_out++;
    u->shift_full = 0;
    if (!(u->isr & TXE))
        load_shifter(unit);
    else
        u->isr |= TC;
    if (byte == 0x7e || !u->shift_full || u->batch_count == BATCH)
        flush(u);
    update_line(unit);
}

static void tdr_write(unsigned unit, uint32_t value)
{
    struct usart *u = &usarts[unit];
    if (!(u->cr1 & UE) || !(u->cr1 & TE))
        fault("%s is given a byte to send while it is off (CR1 = 0x%x)", FIXED[unit].name, u->cr1);
    if (!(u->isr & TXE))
        fault("%s_TDR is written while it is full: the byte before is lost", FIXED[unit].name);
    u->tdr = value & 0xffu;
    u->isr &= ~(uint32_t)(TXE | TC);
    if (!u->shift_full)
        load_shifter(unit);
    update_line(unit);
}

/* ---- in ------------------------------------------------------------------------------------------- */

static void byte_in(void *arg)
{
    struct usart *u = arg;
    unsigned unit = (unsigned)(u - usarts);
    uint8_t byte = u->wire[u->wire_first];
    u->wire_first = (u->wire_first + 1) % WIRE;
    u->wire_count--;
    if (u->wire_count) {
        u->next_receive += byte_ticks(unit);
        event_at(&u->receive, (uint64_t)u->next_receive);
    }
    u->last_idle = u->wire_count == 0;
    if (!on_pin(FIXED[unit].rx))
        return; /* nothing connected */
    if (u->isr & RXNE && !(u->cr3 & OVRDIS)) {
        u->isr |= ORE;
        counters.console_overruns++;
    } else {
        counters.console_overruns += (u->isr & RXNE) != 0;
        u->rdr = byte;
        u->isr |= RXNE;
        if (u->cr3 & DMAR && dma_enabled(FIXED[unit].dma_rx))
            dma_request(FIXED[unit].dma_rx);
    }
    if (byte == u->cr2 >> 24)
        u->isr |= CMF;
    if (u->last_idle)
        u->isr |= IDLE;
    update_line(unit);
}

/* A world without a baud rate of its own on the line hands over a chunk whole: here its bytes come one by one. */
void usart_receive(const uint8_t *data, uint32_t length)
{
    for (unsigned unit = 0; unit < UNITS; unit++) {
        struct usart *u = &usarts[unit];
        if (!(u->cr1 & UE) || !(u->cr1 & RE))
            continue;
        if (!u->wire_count) {
            double start = u->next_receive > (double)now() ? u->next_receive : (double)now();
            u->next_receive = start + byte_ticks(unit);
            event_at(&u->receive, (uint64_t)u->next_receive);
        }
        for (uint32_t i = 0; i < length && u->wire_count < WIRE; i++)
            u->wire[(u->wire_first + u->wire_count++) % WIRE] = data[i];
    }
}

/* ---- registers -------------------------------------------------------------------------------------- */

uint32_t usart_read(unsigned unit, uint32_t offset)
{
    struct usart *u = &usarts[unit];
    switch (offset) {
    case CR1:
        return u->cr1;
    case CR2:
        return u->cr2;
    case CR3:
        return u->cr3;
    case BRR:
        return u->brr;
    case RTOR:
        return 0;
    case ISR:
        return u->isr;
    case RDR:
        u->isr &= ~(uint32_t)RXNE;
        update_line(unit);
        return u->rdr;
    case TDR:
        return u->tdr;
    default:
        return unmodelled_read(FIXED[unit].name, offset);
    }
}

static void cr1_write(unsigned unit, uint32_t value)
{
    struct usart *u = &usarts[unit];
    must_be(FIXED[unit].name, "CR1", value, UE | RE | TE | IDLEIE | RXNEIE | TCIE | TXEIE | CMIE | 1u << 15 | 1u << 8);
    if (value & UE && !(u->cr1 & UE)) {
        if (u->brr < 16)
            fault("%s is switched on with BRR = %u; it must be at least 16 (RM0364, 27.5.4)", FIXED[unit].name, u->brr);
        counters.console_baud = (uint32_t)(BITS * (double)CORE_TICK_HZ / byte_ticks(unit) + 0.5);
    }
    u->cr1 = value;
    u->isr &= ~(uint32_t)(TEACK | REACK);
    if (value & UE)
        u->isr |= (value & TE ? TEACK : 0) | (value & RE ? REACK : 0);
    else
        u->isr = TXE | TC;
    update_line(unit);
}

static void rqr_write(struct usart *u, uint32_t value)
{
    if (value & 1u << 3)
        u->isr &= ~(uint32_t)RXNE;
    if (value & 1u << 4)
        u->isr |= TXE;
}

void usart_write(unsigned unit, uint32_t offset, uint32_t value)
{
    struct usart *u = &usarts[unit];
    const char *name = FIXED[unit].name;
    offset &= 0xfffu;
    switch (offset) {
    case CR1:
        cr1_write(unit, value);
        return;
    case CR2:
        must_be(name, "CR2", value, 0xff003000u);
        if (u->cr1 & UE && (value ^ u->cr2) & 0x3000u)
            fault("%s_CR2 is written while the USART is on (RM0364, 27.8.2)", name);
        u->cr2 = value;
        return;
    case CR3:
        must_be(name, "CR3", value, EIE | DMAR | DMAT | OVRDIS | 1u << 11);
        if (value & DMAT && !(u->cr3 & DMAT) && u->isr & TXE && dma_enabled(FIXED[unit].dma_tx))
            fault("%s: DMAT is set with its DMA channel already running; the model wants the channel last", name);
        u->cr3 = value;
        update_line(unit);
        return;
    case BRR:
        if (u->cr1 & UE)
            fault("%s_BRR is written while the USART is on (RM0364, 27.8.4)", name);
        u->brr = value & 0xffffu;
        return;
    case RQR:
        rqr_write(u, value);
        update_line(unit);
        return;
    case ICR:
        u->isr &= ~(value & 0x121b5fu);
        update_line(unit);
        return;
    case TDR:
        tdr_write(unit, value);
        return;
    default:
        unmodelled_write(name, offset, value);
    }
}

/* A DMA channel has been switched on: the transmitter asks at once if it is empty. */

void usart_dma_enabled(unsigned channel)
{
    for (unsigned unit = 0; unit < UNITS; unit++)
        if (FIXED[unit].dma_tx == channel && usarts[unit].cr3 & DMAT && usarts[unit].cr1 & TE && usarts[unit].isr & TXE)
            dma_request(channel);
}

void usart_reset(unsigned unit)
{
    struct usart *u = &usarts[unit];
    struct event receive = u->receive, transmit = u->transmit;
    memset(u, 0, sizeof *u);
    u->isr = TXE | TC;
    u->receive = receive;
    u->transmit = transmit;
    u->receive.run = byte_in;
    u->transmit.run = byte_out;
    u->receive.arg = u->transmit.arg = u;
    event_at(&u->receive, NEVER);
    event_at(&u->transmit, NEVER);
}
