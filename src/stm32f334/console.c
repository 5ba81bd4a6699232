/* The console: USART2 on PA2 and PA3, which on a Nucleo board is the debugger's virtual serial port.
 *
 *     in    USART ─► DMA channel 6 ─► ring, for ever round; an interrupt only at the byte that ends a block (0x7e)
 *     out   console_send ─► ring ─► DMA channel 7, one run at a time; an interrupt at the end of a run
 *
 * The transmit ring is written in tasks only; a run under way is `sending` bytes from `sent` on.
 *
 * Boot loader.  A host that has closed its connection may send, as plain bytes, `~ \x1c Request Serial Bootloader!! ~`: the
 * chip then starts the boot loader in its ROM (docs/reference/STM32F334.md).
 */
#include <string.h>

#include "board/console.h"
#include "board/irq.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT("SERIAL_BAUD", CONFIG_SERIAL_BAUD);
DECL_CONSTANT("RECEIVE_WINDOW", 192);

enum { RX_SIZE = 256, TX_SIZE = 256, RX_CHANNEL = 6, TX_CHANNEL = 7, BLOCK_END = 0x7e };
#define USART USART2_BASE
#define RX DMA_CHANNEL(RX_CHANNEL)
#define TX DMA_CHANNEL(TX_CHANNEL)

static struct {
    uint8_t rx[RX_SIZE], tx[TX_SIZE];
    uint16_t rx_read;              /* next place to read */
    uint16_t written, sent;        /* running counts of the transmit ring; places are modulo TX_SIZE */
    uint16_t sending;
    uint8_t matched;               /* of the boot loader's request */
} console;

static const char request[] = "~ \x1c Request Serial Bootloader!! ~";

void console_irq(void);
void console_sent_irq(void);
void console_start(void);
void bootloader_requested(void);

void
console_start(void)
{
    pin_set_function(PIN_A + 2, 7);
    pin_set_pull(PIN_A + 3, 1); /* an open line is an idle one */
    pin_set_function(PIN_A + 3, 7);
    uint32_t pclk1 = clock_hz() / 2; /* clock.c divides it whatever the source */
    USART_BRR(USART) = (pclk1 + CONFIG_SERIAL_BAUD / 2) / CONFIG_SERIAL_BAUD;
    USART_CR2(USART) = USART_CR2_ADD4(BLOCK_END >> 4) | USART_CR2_ADD0(BLOCK_END);
    USART_CR3(USART) = USART_CR3_DMAR | USART_CR3_DMAT | USART_CR3_OVRDIS;
    USART_CR1(USART) = USART_CR1_UE | USART_CR1_RE | USART_CR1_TE | USART_CR1_CMIE;
    DMA_CPAR(RX) = (uint32_t)(uintptr_t)&USART_RDR(USART);
    DMA_CMAR(RX) = (uint32_t)(uintptr_t)console.rx;
    DMA_CNDTR(RX) = RX_SIZE;
    DMA_CCR(RX) = DMA_CCR_MINC | DMA_CCR_CIRC | DMA_CCR_PL(1) | DMA_CCR_EN;
    DMA_CPAR(TX) = (uint32_t)(uintptr_t)&USART_TDR(USART);
    irq_allow(IRQ_USART2);
    irq_allow(IRQ_DMA1_CHANNEL7);
}

void
console_irq(void)
{
    USART_ICR(USART) = USART_ICR_CMCF;
    command_wake();
}

/* Interrupts disabled. */
static void
send_run(void)
{
    uint16_t waiting = (uint16_t)(console.written - console.sent), place = console.sent % TX_SIZE;
    if (!waiting || console.sending)
        return;
    console.sending = waiting < TX_SIZE - place ? waiting : TX_SIZE - place;
    DMA_CCR(TX) = 0;
    DMA_CMAR(TX) = (uint32_t)(uintptr_t)&console.tx[place];
    DMA_CNDTR(TX) = console.sending;
    DMA_CCR(TX) = DMA_CCR_MINC | DMA_CCR_DIR | DMA_CCR_TCIE | DMA_CCR_EN;
}

void
console_sent_irq(void)
{
    DMA1_IFCR = DMA1_ISR_TCIF(TX_CHANNEL);
    console.sent += console.sending;
    console.sending = 0;
    send_run();
}

static void
look_for_request(uint8_t byte)
{
    /* The first character comes again only as the last, so a mismatch starts over. */
    console.matched = byte == (uint8_t)request[console.matched] ? console.matched + 1 : byte == (uint8_t)request[0];
    if (!request[console.matched])
        bootloader_requested();
}

uint8_t
console_read(uint8_t *byte)
{
    uint16_t written = (uint16_t)(RX_SIZE - DMA_CNDTR(RX)) % RX_SIZE;
    if (console.rx_read == written)
        return 0;
    *byte = console.rx[console.rx_read];
    console.rx_read = (console.rx_read + 1) % RX_SIZE;
    if (console.matched || *byte == (uint8_t)request[0])
        look_for_request(*byte);
    return 1;
}

void
console_send(const uint8_t *block, uint8_t len)
{
    irqstatus_t flag = irq_save();
    uint16_t free = TX_SIZE - (uint16_t)(console.written - console.sent);
    irq_restore(flag);
    if (len > free)
        return;
    uint16_t place = console.written % TX_SIZE, whole = TX_SIZE - place < len ? TX_SIZE - place : len;
    memcpy(console.tx + place, block, whole);
    if (whole < len)
        memcpy(console.tx, block + whole, (size_t)(len - whole));
    flag = irq_save();
    console.written += len;
    send_run();
    irq_restore(flag);
}

void
console_init(void)
{
    memset(&console, 0, sizeof(console));
}
DECL_INIT(console_init);
