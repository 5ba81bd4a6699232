/* The console: USART0, PE0 in and PE1 out, which on an Arduino board is the USB adapter.
 *
 * Two rings, an interrupt a byte.  Tasks are woken by the byte that ends a block only.  250000 baud is an exact division of
 * 16 MHz (datasheet 22.11); a byte takes 40 us, and the hardware holds two more while one comes in.
 */
#include "board/console.h"
#include "board/irq.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT("SERIAL_BAUD", CONFIG_SERIAL_BAUD);
DECL_CONSTANT("RECEIVE_WINDOW", 192);

enum { RX_SIZE = 256, TX_SIZE = 256, BLOCK_END = 0x7e };

/* Counts wrap with the rings. */
static volatile uint8_t rx_in, rx_out, tx_in, tx_out;
static uint8_t rx_ring[RX_SIZE], tx_ring[TX_SIZE];

void
console_start(void)
{
    UCSR0A = 1 << U2X0;
    UBRR0 = (PORT_CLOCK_HZ + CONFIG_SERIAL_BAUD * 4) / (CONFIG_SERIAL_BAUD * 8) - 1;
    UCSR0C = 1 << UCSZ01 | 1 << UCSZ00;
    UCSR0B = 1 << RXEN0 | 1 << TXEN0 | 1 << RXCIE0;
}

ISR(USART0_RX_vect)
{
    uint8_t byte = UDR0, next = rx_in + 1;
    if (next == rx_out)
        return;
    rx_ring[rx_in] = byte;
    rx_in = next;
    if (byte == BLOCK_END)
        command_wake();
}

ISR(USART0_UDRE_vect)
{
    if (tx_out == tx_in)
        UCSR0B &= (uint8_t) ~(1 << UDRIE0);
    else
        UDR0 = tx_ring[tx_out++];
}

uint8_t
console_read(uint8_t *byte)
{
    if (rx_out == rx_in)
        return 0;
    *byte = rx_ring[rx_out++];
    return 1;
}

void
console_send(const uint8_t *block, uint8_t len)
{
    uint8_t in = tx_in;
    if ((uint8_t)(tx_out - in - 1) < len)
        return;
    for (; len; len--)
        tx_ring[in++] = *block++;
    irqstatus_t flag = irq_save();
    tx_in = in;
    UCSR0B |= 1 << UDRIE0;
    irq_restore(flag);
}

void
console_init(void)
{
    rx_in = rx_out = tx_in = tx_out = 0;
}
DECL_INIT(console_init);
