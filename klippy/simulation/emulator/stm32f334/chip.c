/* The STM32F334's address map: which block answers where, and whether its clock runs. */
#include "chip.h"

#include <stdio.h>
#include <string.h>

#include "chip_sensor.h"

const uint32_t chip_flash_base = 0x08000000u;

/* SRAM 12 KiB, CCM 4 KiB, flash 64 KiB (DS9994); the system memory's page holds unique id and flash size. */
const struct chip_region chip_regions[] = {
    { 0x08000000u, 0x10000u, 0, "flash" },
    { 0x20000000u, 0x3000u, 1, "SRAM" },
    { 0x10000000u, 0x1000u, 1, "CCM" },
    { 0x1fffd000u, 0x3000u, 0, "system memory" },
    { 0, 0, 0, NULL },
};

/* In place of the boot loader (AN2606: the STM32F334's begins at 0x1fffd800): a vector table and two instructions that do
 * nothing, for ever.  Where somebody jumps to it shows by the program counter. */
const struct elf_segment *chip_rom(void)
{
    enum { BASE = 0x1fffd800 };
    static const uint32_t words[] = { 0x20000800u, BASE + 9, 0xe7fdbf30u /* wfi; b back to it */ };
    static const struct elf_segment rom = { BASE, sizeof words, (const uint8_t *)words };
    return &rom;
}

struct mutations mutation;

static const struct peripheral peripherals[] = {
    { "GPIOA", 0x48000000u, 0x400, CLOCK_BIT(RCC_AHBENR, 17), gpio_read, gpio_write, gpio_reset, 0 },
    { "GPIOB", 0x48000400u, 0x400, CLOCK_BIT(RCC_AHBENR, 18), gpio_read, gpio_write, gpio_reset, 1 },
    { "GPIOC", 0x48000800u, 0x400, CLOCK_BIT(RCC_AHBENR, 19), gpio_read, gpio_write, gpio_reset, 2 },
    { "GPIOD", 0x48000c00u, 0x400, CLOCK_BIT(RCC_AHBENR, 20), gpio_read, gpio_write, gpio_reset, 3 },
    { "GPIOF", 0x48001400u, 0x400, CLOCK_BIT(RCC_AHBENR, 22), gpio_read, gpio_write, gpio_reset, 5 },
    { "RCC", 0x40021000u, 0x400, 0, rcc_read, rcc_write, NULL, 0 },
    { "FLASH", 0x40022000u, 0x400, CLOCK_BIT(RCC_AHBENR, 4), flash_read, flash_write, flash_reset, 0 },
    { "CRC", 0x40023000u, 0x400, CLOCK_BIT(RCC_AHBENR, 6), crc_read, crc_write, crc_reset, 0 },
    { "DMA1", 0x40020000u, 0x400, CLOCK_BIT(RCC_AHBENR, 0), dma_read, dma_write, dma_reset, 0 },
    { "ADC", 0x50000000u, 0x400, CLOCK_BIT(RCC_AHBENR, 28), adc_read_register, adc_write_register, adc_reset, 0 },
    { "TIM2", 0x40000000u, 0x400, CLOCK_BIT(RCC_APB1ENR, 0), timer_read, timer_write, timer_reset, 0 },
    { "TIM3", 0x40000400u, 0x400, CLOCK_BIT(RCC_APB1ENR, 1), timer_read, timer_write, timer_reset, 1 },
    { "TIM6", 0x40001000u, 0x400, CLOCK_BIT(RCC_APB1ENR, 4), timer_read, timer_write, timer_reset, 2 },
    { "TIM7", 0x40001400u, 0x400, CLOCK_BIT(RCC_APB1ENR, 5), timer_read, timer_write, timer_reset, 3 },
    { "TIM1", 0x40012c00u, 0x400, CLOCK_BIT(RCC_APB2ENR, 11), timer_read, timer_write, timer_reset, 4 },
    { "TIM15", 0x40014000u, 0x400, CLOCK_BIT(RCC_APB2ENR, 16), timer_read, timer_write, timer_reset, 5 },
    { "TIM16", 0x40014400u, 0x400, CLOCK_BIT(RCC_APB2ENR, 17), timer_read, timer_write, timer_reset, 6 },
    { "TIM17", 0x40014800u, 0x400, CLOCK_BIT(RCC_APB2ENR, 18), timer_read, timer_write, timer_reset, 7 },
    { "USART1", 0x40013800u, 0x400, CLOCK_BIT(RCC_APB2ENR, 14), usart_read, usart_write, usart_reset, 0 },
    { "USART2", 0x40004400u, 0x400, CLOCK_BIT(RCC_APB1ENR, 17), usart_read, usart_write, usart_reset, 1 },
    { "USART3", 0x40004800u, 0x400, CLOCK_BIT(RCC_APB1ENR, 18), usart_read, usart_write, usart_reset, 2 },
    { "SPI1", 0x40013000u, 0x400, CLOCK_BIT(RCC_APB2ENR, 12), spi_read, spi_write, spi_reset, 0 },
    { "I2C1", 0x40005400u, 0x400, CLOCK_BIT(RCC_APB1ENR, 21), i2c_read, i2c_write, i2c_reset, 0 },
    { "HRTIM1", 0x40017400u, 0x400, CLOCK_BIT(RCC_APB2ENR, 29), hrtim_read, hrtim_write, hrtim_reset, 0 },
    { "SYSCFG", 0x40010000u, 0x400, CLOCK_BIT(RCC_APB2ENR, 0), syscfg_read, syscfg_write, syscfg_reset, 0 },
    { "EXTI", 0x40010400u, 0x400, 0, exti_read, exti_write, exti_reset, 0 },
    { "PWR", 0x40007000u, 0x400, CLOCK_BIT(RCC_APB1ENR, 28), pwr_read, pwr_write, pwr_reset, 0 },
    { "IWDG", 0x40003000u, 0x400, 0, iwdg_read, iwdg_write, iwdg_reset, 0 },
    { "DBGMCU", 0xe0042000u, 0x400, 0, dbgmcu_read, dbgmcu_write, dbgmcu_reset, 0 },
};
enum { PERIPHERALS = sizeof peripherals / sizeof *peripherals };

/* Every block lies in a kilobyte of its own; the table is found by hashing that kilobyte's number. */
static uint8_t slot_of[1024];

static unsigned slot(uint32_t address)
{
    uint32_t kilobyte = address >> 10;
    return (kilobyte & 0xff) | (address >> 27 & 1u) << 8 | (address >> 28 & 1u) << 9;
}

static const struct peripheral *find(uint32_t address)
{
    if (!slot_of[slot(0x40021000u)])
        for (unsigned i = 0; i < PERIPHERALS; i++)
            slot_of[slot(peripherals[i].base)] = (uint8_t)(i + 1);
    unsigned i = slot_of[slot(address)];
    if (!i || address - peripherals[i - 1].base >= peripherals[i - 1].size)
        return NULL;
    return &peripherals[i - 1];
}

static const struct peripheral *usable(uint32_t address, const char *what)
{
    const struct peripheral *p = find(address);
    if (!p) {
        fault("%s 0x%08x: no peripheral is modelled there", what, address);
        return NULL;
    }
    if (p->clock && !rcc_enabled(p->clock)) {
        fault("%s %s (0x%08x) while its clock is off in the RCC", what, p->name, address);
        return NULL;
    }
    return p;
}

uint32_t chip_read(uint32_t address, unsigned size)
{
    const struct peripheral *p = usable(address & ~3u, "a read of");
    if (!p)
        return 0;
    uint32_t value = p->read(p->unit, address & 0x3fcu) >> 8 * (address & 3u);
    return size == 4 ? value : value & ((1u << 8 * size) - 1u);
}

/* Narrow writes: only where the manual gives them a meaning of their own, or the upper bits are reserved. */
void chip_write(uint32_t address, uint32_t value, unsigned size)
{
    const struct peripheral *p = usable(address & ~3u, "a write to");
    if (!p)
        return;
    uint32_t offset = address & 0x3ffu;
    if (size < 4 && (p->write == gpio_write || p->write == spi_write || p->write == usart_write || p->write == crc_write)) {
        p->write(p->unit, offset | size << 28, value);
        return;
    }
    if (size < 4 && (size != 2 || p->write != hrtim_write || offset & 3u)) {
        fault("a write of %u bytes to %s + 0x%x: its registers take words", size, p->name, offset);
        return;
    }
    p->write(p->unit, offset, value);
}

uint32_t unmodelled_read(const char *name, uint32_t offset)
{
    fault("a read of %s + 0x%02x, a register that is not modelled or does not exist", name, offset);
    return 0;
}

void unmodelled_write(const char *name, uint32_t offset, uint32_t value)
{
    fault("a write of 0x%x to %s + 0x%02x, a register that is not modelled or does not exist", value, name, offset);
}

void must_be(const char *name, const char *reg, uint32_t value, uint32_t allowed)
{
    if (value & ~allowed)
        fault("%s_%s = 0x%08x: the bits 0x%08x are reserved or not modelled", name, reg, value, value & ~allowed);
}

/* What the chip is and how much flash it has (RM0364, 31.1 and 31.2), its temperature sensor's readings in the factory. */
static void fill_system_memory(void)
{
    static int done;
    static const uint32_t UID[3] = { 0x00390031u, 0x34305109u, 0x38313732u };
    uint16_t kilobytes = 64, cold = chip_sensor_code(30.0), hot = chip_sensor_code(110.0); /* DS9994: TS_CAL1, TS_CAL2, at 3.3 V */
    if (!done) {
        memcpy(core_memory(0x1ffff7b8u), &cold, sizeof cold);
        memcpy(core_memory(0x1ffff7c2u), &hot, sizeof hot);
        memcpy(core_memory(0x1ffff7acu), UID, sizeof UID);
        memcpy(core_memory(0x1ffff7ccu), &kilobytes, sizeof kilobytes);
        done = 1;
    }
}

void chip_reset(uint32_t cause)
{
    fill_system_memory();
    rcc_power_on(cause);
    for (unsigned i = 0; i < PERIPHERALS; i++)
        if (peripherals[i].reset)
            peripherals[i].reset(peripherals[i].unit);
}

void chip_receive(const uint8_t *data, uint32_t length)
{
    usart_receive(data, length);
}

int chip_keeps_memory(void)
{
    return mutation.supply_dip != 0;
}

void chip_sync(void)
{
    adc_sync();
}

int chip_mutate(const char *what, uint32_t value)
{
    static const struct { const char *name; size_t place; } NAMES[] = {
        { "no_crystal", offsetof(struct mutations, no_crystal) },
        { "no_pll", offsetof(struct mutations, no_pll) },
        { "adc_uncalibrated", offsetof(struct mutations, adc_uncalibrated) },
        { "adc_dead", offsetof(struct mutations, adc_dead) },
        { "no_dll", offsetof(struct mutations, no_dll) },
        { "fault_line", offsetof(struct mutations, fault_line) },
        { "brown_out", offsetof(struct mutations, brown_out) },
        { "clock_stuck", offsetof(struct mutations, clock_stuck) },
        { "dma_dead", offsetof(struct mutations, dma_dead) },
        { "crystal_stops", offsetof(struct mutations, crystal_stops) },
        { "supply_dip", offsetof(struct mutations, supply_dip) },
        { "hrtim_dead", offsetof(struct mutations, hrtim_dead) },
        { "hard_fault", offsetof(struct mutations, hard_fault) },
        { "compare_dead", offsetof(struct mutations, compare_dead) },
    };
    for (size_t i = 0; i < sizeof NAMES / sizeof *NAMES; i++)
        if (!strcmp(NAMES[i].name, what)) {
            memcpy((char *)&mutation + NAMES[i].place, &value, sizeof value);
            hrtim_fault_line();
            if (mutation.crystal_stops)
                rcc_crystal_stops();
            if (mutation.hard_fault)
                nvic_pend(EXC_HARD_FAULT);
            mutation.hard_fault = 0;
            return 0;
        }
    return -1;
}

int chip_peek(const char *what, uint32_t *value)
{
    if (!strncmp(what, "hrtim.", 6))
        return hrtim_peek(what + 6, value);
    if (!strcmp(what, "ticks"))
        *value = (uint32_t)now(); /* the chip's present: at most a basic block beyond the clock last advanced to */
    else if (!strcmp(what, "syscfg.remap"))
        *value = syscfg_remap();
    else if (!strcmp(what, "tim2.count"))
        *value = timer_read(0, 0x24);
    else
        return -1;
    return 0;
}

/* Positions of the vector table that RM0364 (table 29) leaves reserved. */
int chip_irq_exists(unsigned irq)
{
    static const uint32_t EXISTS[3] = {
        /* 0..10, 11..17 DMA1, 18 ADC1_2, 19..22 CAN, 23 EXTI9_5, 24..27 TIM1, 28 TIM2, 29 TIM3, 31 I2C1_EV */
        0xbfffffffu,
        /* 32 I2C1_ER, 35 SPI1, 37..39 USART, 40 EXTI15_10, 41 RTC alarm, 54 TIM6, 55 TIM7 */
        1u << 0 | 1u << 3 | 7u << 5 | 3u << 8 | 3u << 22,
        /* 64 COMP2, 65 COMP4_6, 67..73 HRTIM, 81 FPU */
        3u << 0 | 0x7fu << 3 | 1u << 17,
    };
    return irq < 96 && EXISTS[irq >> 5] >> (irq & 31) & 1u;
}
