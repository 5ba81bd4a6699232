/* SPI1, byte by byte and polled: its devices are thermocouple converters and stepper drivers, a few bytes at a time. */
#include "board/spi.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_ENUMERATION("spi_bus", "spi1", 0);
DECL_CONSTANT_STR("BUS_PINS_spi1", "PB4,PB5,PB3");

enum { MODE_MAX = 3, DIVIDER_MAX = 7, FUNCTION_SPI = 5 };
static const uint32_t apb2_hz = 72000000;

struct spi_bus
spi_bus_open(uint32_t bus, uint8_t mode, uint32_t rate_hz)
{
    if (bus)
        shutdown(SHUTDOWN_SPI_BUS);
    uint32_t divider = 0; /* APB2 / 2^(divider + 1) */
    while (divider < DIVIDER_MAX && (apb2_hz >> (divider + 1)) > rate_hz)
        divider++;
    if (mode > MODE_MAX || !rate_hz || (apb2_hz >> (divider + 1)) > rate_hz)
        shutdown(SHUTDOWN_SPI_SETUP);
    RCC_APB2ENR |= RCC_APB2ENR_SPI1EN;
    (void)RCC_APB2ENR;
    for (uint32_t pin = PIN_B + 3; pin <= PIN_B + 5; pin++)
        pin_set_function(pin, FUNCTION_SPI);
    uint32_t control = SPI_CR1_MSTR | SPI_CR1_SSM | SPI_CR1_SSI | SPI_CR1_BR(divider);
    return (struct spi_bus){ (uint16_t)(control | (mode & 2 ? SPI_CR1_CPOL : 0) | (mode & 1 ? SPI_CR1_CPHA : 0)) };
}

void
spi_bus_prepare(struct spi_bus b)
{
    if (SPI_CR1(SPI1_BASE) == (b.control | SPI_CR1_SPE))
        return;
    SPI_CR1(SPI1_BASE) = b.control;
    SPI_CR2(SPI1_BASE) = SPI_CR2_DS(7) | SPI_CR2_FRXTH;
    SPI_CR1(SPI1_BASE) = b.control | SPI_CR1_SPE;
}

void
spi_bus_exchange(struct spi_bus b, uint8_t *data, uint8_t len, uint8_t keep_reply)
{
    (void)b;
    /* A transfer that a shutdown cut in two may have left bytes. */
    while (SPI_SR(SPI1_BASE) & (SPI_SR_RXNE | SPI_SR_BSY))
        if (SPI_SR(SPI1_BASE) & SPI_SR_RXNE)
            (void)SPI_DR8(SPI1_BASE);
    for (uint8_t i = 0; i < len; i++) {
        SPI_DR8(SPI1_BASE) = data[i];
        while (!(SPI_SR(SPI1_BASE) & SPI_SR_RXNE))
            ;
        uint8_t reply = SPI_DR8(SPI1_BASE);
        if (keep_reply)
            data[i] = reply;
    }
    while (SPI_SR(SPI1_BASE) & SPI_SR_BSY)
        ;
}
