/* Timer5, USART0, ADC, SPI. */
#include <string.h>

#include "chip.h"

/****************************************************************
 * Timer5: normal mode, undivided (datasheet chapter 17)
 ****************************************************************/

enum { TOV = 1 << 0, OCFA = 1 << 1 };

static struct {
    uint64_t zero;          /* a cycle at which it stood at 0 */
    uint8_t runs, flags, high_byte;
    uint16_t compare;
} t5;

static uint16_t
t5_count(void)
{
    return t5.runs ? (uint16_t)(chip->cycle - t5.zero) : 0;
}

static int
t5_overflow_level(void)
{
    return t5.flags & chip->data[REG_TIMSK5] & TOV;
}

static int
t5_compare_level(void)
{
    return t5.flags & chip->data[REG_TIMSK5] & OCFA;
}

static void
t5_overflow_taken(void)
{
    t5.flags &= (uint8_t)~TOV;
}

static void
t5_compare_taken(void)
{
    t5.flags &= (uint8_t)~OCFA;
}

static avr_cycle_count_t
t5_overflow(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)param;
    t5.flags |= TOV;
    request_check(VECTOR_TIMER5_OVF);
    return when + 0x10000;
}

static avr_cycle_count_t
t5_match(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)param;
    t5.flags |= OCFA;
    request_check(VECTOR_TIMER5_COMPA);
    return when + 0x10000;
}

static void
t5_rearm(void)
{
    uint16_t ahead = (uint16_t)(t5.compare - t5_count());
    after(ahead ? ahead : 0x10000, t5_match);
}

static void
t5_write(uint16_t address, uint8_t value)
{
    need_power(REG_PRR1, 5, "timer 5");
    switch (address) {
    case REG_TCCR5A:
        if (value)
            chip_fault("timer 5 gets mode 0x%02x, the model has normal mode only", value);
        break;
    case REG_TCCR5B:
        if (value != 1)
            chip_fault("timer 5 gets clock 0x%02x, the model has the undivided one only", value);
        if (!t5.runs) {
            t5.runs = 1;
            t5.zero = chip->cycle;
            after(0x10000, t5_overflow);
            t5_rearm();
        }
        break;
    case REG_OCR5AH:
        t5.high_byte = value;
        break;
    case REG_OCR5AL:
        t5.compare = (uint16_t)(t5.high_byte << 8 | value);
        if (t5.runs)
            t5_rearm();
        break;
    case REG_TIFR5:
        t5.flags &= (uint8_t)~value;
        break;
    }
    chip->data[address] = value;
    request_check(VECTOR_TIMER5_OVF);
    request_check(VECTOR_TIMER5_COMPA);
}

static uint8_t
t5_read(uint16_t address)
{
    if (address == REG_TIFR5)
        return t5.flags;
    if (address == REG_TCNT5H)
        return t5.high_byte;
    t5.high_byte = (uint8_t)(t5_count() >> 8);
    return (uint8_t)t5_count();
}

void
timer5_init(void)
{
    static const uint16_t registers[] = { REG_TCCR5A, REG_TCCR5B, REG_OCR5AL, REG_OCR5AH, REG_TIFR5, REG_TIMSK5 };
    for (unsigned i = 0; i < sizeof registers / sizeof registers[0]; i++)
        on_write(registers[i], t5_write);
    on_read(REG_TIFR5, t5_read);
    on_read(REG_TCNT5L, t5_read);
    on_read(REG_TCNT5H, t5_read);
    request(VECTOR_TIMER5_OVF, t5_overflow_level, t5_overflow_taken);
    request(VECTOR_TIMER5_COMPA, t5_compare_level, t5_compare_taken);
}

uint64_t
timer5_zero(void)
{
    return t5.zero;
}

void
timer5_reset(void)
{
    memset(&t5, 0, sizeof t5);
}

/****************************************************************
 * USART0 (datasheet chapter 22)
 ****************************************************************/

enum {
    MPCM = 1 << 0, U2X = 1 << 1, DOR = 1 << 3, UDRE = 1 << 5, TXC = 1 << 6, RXC = 1 << 7,   /* UCSR0A */
    TXEN = 1 << 3, RXEN = 1 << 4, UDRIE = 1 << 5, RXCIE = 1 << 7,                            /* UCSR0B */
    FRAME_8N1 = 0x06,
    HELD = 3,               /* two in the buffer, one complete in the shift register */
    LINE_SIZE = 1 << 14,
};

static struct {
    uint8_t line[LINE_SIZE];        /* bytes on their way to the chip */
    uint32_t line_in, line_out;
    uint8_t held[HELD], held_count, overrun;
    uint8_t data, data_full, shifting, shift;
} usart;

static uint64_t
byte_cycles(void)
{
    uint32_t ubrr = (uint32_t)(chip->data[REG_UBRR0H] << 8 | chip->data[REG_UBRR0L]);
    uint32_t divider = chip->data[REG_UCSR0A] & U2X ? 8 : 16;
    counters.console_baud = CLOCK_HZ / (divider * (ubrr + 1));
    return 10ull * divider * (ubrr + 1);
}

static void
usart_check(void)
{
    request_check(VECTOR_USART0_RX);
    request_check(VECTOR_USART0_UDRE);
}

static int
rx_level(void)
{
    return usart.held_count && chip->data[REG_UCSR0B] & RXCIE;
}

static int
udre_level(void)
{
    return !usart.data_full && chip->data[REG_UCSR0B] & UDRIE;
}

static avr_cycle_count_t
byte_arrived(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)param;
    uint8_t byte = usart.line[usart.line_out++ % LINE_SIZE];
    if (chip->data[REG_UCSR0B] & RXEN) {
        counters.console_bytes_in++;
        if (usart.held_count < HELD) {
            usart.held[usart.held_count++] = byte;
        } else {
            usart.overrun = 1;
            counters.console_overruns++;
        }
        usart_check();
    }
    return usart.line_in == usart.line_out ? 0 : when + byte_cycles();
}

void
usart_receive(const uint8_t *data, uint32_t len)
{
    if (usart.line_in == usart.line_out && len)
        after(byte_cycles(), byte_arrived);
    for (; len; len--) {
        if (usart.line_in - usart.line_out == LINE_SIZE)
            return; /* a host that sends faster than the line carries */
        usart.line[usart.line_in++ % LINE_SIZE] = *data++;
    }
}

static avr_cycle_count_t
byte_sent(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)param;
    counters.console_bytes_out++;
    board.console_send(board.ctx, &usart.shift, 1, chip_clock());
    usart.shifting = usart.data_full;
    usart.shift = usart.data;
    usart.data_full = 0;
    usart_check();
    return usart.shifting ? when + byte_cycles() : 0;
}

static void
transmit(uint8_t byte)
{
    if (!(chip->data[REG_UCSR0B] & TXEN))
        chip_fault("a byte is sent while the transmitter is off");
    if (usart.data_full)
        chip_fault("a byte is written to UDR0 while the one before it waits there");
    if (usart.shifting) {
        usart.data = byte;
        usart.data_full = 1;
        return;
    }
    usart.shift = byte;
    usart.shifting = 1;
    after(byte_cycles(), byte_sent);
}

static void
usart_write(uint16_t address, uint8_t value)
{
    need_power(REG_PRR0, 1, "USART0");
    if (address == REG_UDR0) {
        transmit(value);
    } else {
        if (address == REG_UCSR0C && value != FRAME_8N1)
            chip_fault("USART0 gets frame format 0x%02x, the line has 8N1", value);
        if (address == REG_UCSR0A && value & MPCM)
            chip_fault("USART0 gets multi-processor mode");
        chip->data[address] = address == REG_UCSR0A ? value & U2X : value;
    }
    usart_check();
}

static uint8_t
usart_read(uint16_t address)
{
    if (address == REG_UCSR0A)
        return (uint8_t)(chip->data[REG_UCSR0A] | (usart.held_count ? RXC : 0) | (usart.data_full ? 0 : UDRE)
                         | (usart.overrun ? DOR : 0) | (usart.shifting ? 0 : TXC));
    uint8_t byte = usart.held[0];
    if (usart.held_count)
        memmove(usart.held, usart.held + 1, --usart.held_count);
    usart.overrun = 0;
    usart_check();
    return byte;
}

void
usart_init(void)
{
    for (uint16_t address = REG_UCSR0A; address <= REG_UDR0; address++)
        if (address != REG_UCSR0C + 1)
            on_write(address, usart_write);
    on_read(REG_UCSR0A, usart_read);
    on_read(REG_UDR0, usart_read);
    request(VECTOR_USART0_RX, rx_level, NULL);
    request(VECTOR_USART0_UDRE, udre_level, NULL);
}

void
usart_reset(void)
{
    memset(&usart, 0, sizeof usart);
    chip->data[REG_UCSR0C] = FRAME_8N1;
}

/****************************************************************
 * ADC: single conversions against AVCC (datasheet chapter 26)
 ****************************************************************/

enum { ADSC = 1 << 6, ADIF = 1 << 4, ADEN = 1 << 7, ADIE = 1 << 3, ADATE = 1 << 5, REFS_AVCC = 0x40, MUX5 = 1 << 3 };

static struct {
    uint8_t converting, warm;
    uint32_t pin;
} adc;

static avr_cycle_count_t
converted(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)when;
    (void)param;
    uint16_t code = board.adc_read(board.ctx, adc.pin, chip_clock()) >> 2; /* the world's boards have twelve bits */
    chip->data[REG_ADCL] = (uint8_t)code;
    chip->data[REG_ADCH] = (uint8_t)(code >> 8);
    chip->data[REG_ADCSRA] = (uint8_t)((chip->data[REG_ADCSRA] & ~ADSC) | ADIF);
    adc.converting = 0;
    adc.warm = 1;
    return 0;
}

static void
begin_conversion(uint8_t control)
{
    uint32_t prescaler = control & 7 ? 1u << (control & 7) : 2u;
    uint32_t rate = CLOCK_HZ / prescaler;
    uint8_t mux = chip->data[REG_ADMUX];
    if (rate < 50000 || rate > 200000)
        chip_fault("the ADC runs at %u Hz; ten bits need 50 to 200 kHz", rate);
    if ((mux & 0xe0) != REFS_AVCC || mux & 0x18)
        chip_fault("ADMUX 0x%02x: the model has single inputs against AVCC, right adjusted", mux);
    adc.pin = (uint32_t)((chip->data[REG_ADCSRB] & MUX5 ? 9 * 8 : 5 * 8) + (mux & 7));
    adc.converting = 1;
    after((adc.warm ? 13u : 25u) * prescaler, converted);
}

static void
adc_write(uint16_t address, uint8_t value)
{
    need_power(REG_PRR0, 0, "ADC");
    uint8_t old = chip->data[address];
    if (address == REG_ADCSRA) {
        if (value & (ADIE | ADATE))
            chip_fault("ADCSRA 0x%02x: the model has no ADC interrupt or trigger", value);
        uint8_t flag = value & ADIF ? 0 : old & ADIF;
        chip->data[address] = (uint8_t)((value & ~ADIF) | flag | (adc.converting ? ADSC : 0));
        if (value & ADSC && !adc.converting) {
            if (value & ADEN)
                begin_conversion(value);
            else
                chip_fault("a conversion is started while the ADC is off");
        }
        return;
    }
    if (adc.converting && value != old)
        chip_fault("the ADC's input is changed during a conversion");
    chip->data[address] = value;
}

void
analog_init(void)
{
    on_write(REG_ADCSRA, adc_write);
    on_write(REG_ADCSRB, adc_write);
    on_write(REG_ADMUX, adc_write);
}

void
analog_reset(void)
{
    memset(&adc, 0, sizeof adc);
}

/****************************************************************
 * SPI master (datasheet chapter 21)
 ****************************************************************/

enum { SPE = 1 << 6, DORD = 1 << 5, MSTR = 1 << 4, SPIE = 1 << 7, SPIF = 1 << 7, SPI2X = 1 << 0 };

static struct {
    uint8_t shifting, reply, flag_seen;
} spi;

static avr_cycle_count_t
spi_done(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)when;
    (void)param;
    chip->data[REG_SPSR] |= SPIF;
    spi.shifting = 0;
    return 0;
}

static void
spi_start(uint8_t byte)
{
    static const uint8_t dividers[] = { 4, 16, 64, 128 };
    uint8_t control = chip->data[REG_SPCR];
    uint32_t divider = dividers[control & 3] / (chip->data[REG_SPSR] & SPI2X ? 2u : 1u);
    if (!(control & SPE) || !(control & MSTR))
        chip_fault("a byte is sent while the SPI is not on as master");
    if (spi.shifting)
        chip_fault("a byte is written to SPDR while the one before it is shifted");
    if ((chip->data[REG_PINA + 3 + REG_DDR] & 7) != 7)
        chip_fault("SPI: PB0, PB1 and PB2 must be outputs");
    spi.reply = byte;
    if (board.spi_exchange)
        board.spi_exchange(board.ctx, 0, control >> 2 & 3, &spi.reply, 1, chip_clock());
    else
        spi.reply = 0xff;
    spi.shifting = 1;
    chip->data[REG_SPSR] &= (uint8_t)~SPIF;
    after(8ull * divider, spi_done);
}

static void
spi_write(uint16_t address, uint8_t value)
{
    need_power(REG_PRR0, 2, "SPI");
    if (address == REG_SPDR)
        spi_start(value);
    else if (address == REG_SPCR && value & (DORD | SPIE))
        chip_fault("SPCR 0x%02x: the model has no SPI interrupt and sends the highest bit first", value);
    else
        chip->data[address] = address == REG_SPSR ? (uint8_t)((chip->data[address] & SPIF) | (value & SPI2X)) : value;
}

static uint8_t
spi_read(uint16_t address)
{
    (void)address;
    chip->data[REG_SPSR] &= (uint8_t)~SPIF; /* in truth only after SPSR has been read, which the wait has done */
    return spi.reply;
}

void
spi_init(void)
{
    on_write(REG_SPCR, spi_write);
    on_write(REG_SPSR, spi_write);
    on_write(REG_SPDR, spi_write);
    on_read(REG_SPDR, spi_read);
}

void
spi_reset(void)
{
    memset(&spi, 0, sizeof spi);
}
