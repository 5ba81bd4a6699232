/* The clock tree: 8 MHz from outside (the Nucleo board's debugger, or a crystal) times nine.
 *
 *     HSE 8 MHz ─► PLL x9 ─► 72 MHz ─► AHB ─► core, DMA, memory, ADC (synchronous, undivided)
 *                       │             ├─► /2 APB1 36 MHz ─► USART2, I2C1;  x2 ─► TIM2, TIM3 72 MHz
 *                       │             └─► /1 APB2 72 MHz ─► SPI1, TIM15..17
 *                       └─ x2 ─► 144 MHz ─► HRTIM, x32 by its delay lines: 4.608 GHz equivalent
 *
 * Without the outside clock the chip runs at 64 MHz from its own oscillator, so that it can still report to the host what is
 * wrong; the bridge, whose frequency is the thermometer's scale, is then refused.
 */
#include "internal.h"

enum { SPIN_LIMIT = 200000 };  /* rounds of a waiting loop: some 20 ms or more; DS9994: HSE 2 ms, PLL 200 us */

static uint8_t on_crystal;

static uint8_t
wait_for(volatile uint32_t *reg, uint32_t mask, uint32_t value)
{
    for (uint32_t spin = 0; spin < SPIN_LIMIT; spin++)
        if ((*reg & mask) == value)
            return 1;
    return 0;
}

static uint8_t
start_crystal(void)
{
    if (CONFIG_HSE_BYPASS)
        RCC_CR |= RCC_CR_HSEBYP;
    RCC_CR |= RCC_CR_HSEON;
    if (wait_for(&RCC_CR, RCC_CR_HSERDY, RCC_CR_HSERDY))
        return 1;
    RCC_CR &= ~RCC_CR_HSEON;
    return 0;
}

/* PLLMUL n is a factor of n + 2. */
static const uint32_t cfgr_buses = RCC_CFGR_HPRE(0) | RCC_CFGR_PPRE1(4) | RCC_CFGR_PPRE2(0);
static const uint32_t cfgr_crystal = RCC_CFGR_PLLSRC | RCC_CFGR_PLLMUL(7);
static const uint32_t cfgr_own = RCC_CFGR_PLLMUL(14); /* HSI / 2 x 16 = 64 MHz */

uint8_t
clock_start(void)
{
    RCC_AHBENR |= RCC_AHBENR_FLITFEN | RCC_AHBENR_SRAMEN;
    FLASH_ACR = FLASH_ACR_LATENCY(2) | FLASH_ACR_PRFTBE; /* 2 wait states from 48 MHz on */
    on_crystal = start_crystal();
    RCC_CFGR2 = RCC_CFGR2_PREDIV(0);
    RCC_CFGR = cfgr_buses | (on_crystal ? cfgr_crystal : cfgr_own);
    RCC_CR |= RCC_CR_PLLON;
    if (!wait_for(&RCC_CR, RCC_CR_PLLRDY, RCC_CR_PLLRDY)) {
        on_crystal = 0;
        return 0; /* 8 MHz from the HSI it stays */
    }
    RCC_CFGR |= RCC_CFGR_SW(2);
    if (!wait_for(&RCC_CFGR, RCC_CFGR_SWS(3), RCC_CFGR_SWS(2)))
        on_crystal = 0;
    if (on_crystal)
        RCC_CR |= RCC_CR_CSSON; /* a crystal that stops: NMI, and HRTIM outputs off by hardware */
    return clock_verify();
}

uint8_t
clock_verify(void)
{
    const uint32_t cr = RCC_CR_HSERDY | RCC_CR_PLLRDY | RCC_CR_CSSON;
    const uint32_t cfgr_mask = RCC_CFGR_SWS(3) | RCC_CFGR_HPRE(15) | RCC_CFGR_PPRE1(7) | RCC_CFGR_PPRE2(7) | RCC_CFGR_PLLSRC |
                               RCC_CFGR_PLLMUL(15);
    return on_crystal && (RCC_CR & cr) == cr && (RCC_CFGR & cfgr_mask) == (cfgr_buses | cfgr_crystal | RCC_CFGR_SWS(2)) &&
           !(RCC_CFGR2 & RCC_CFGR2_PREDIV(15));
}

/****************************************************************
 * Clocks of the peripherals that always run.  HRTIM, ADC and buses get theirs when they are set up.
 ****************************************************************/

static const uint32_t ahb_voice = RCC_AHBENR_IOPAEN | RCC_AHBENR_DMAEN | RCC_AHBENR_CRCEN;
static const uint32_t ahb_other = RCC_AHBENR_IOPBEN | RCC_AHBENR_IOPCEN | RCC_AHBENR_IOPDEN | RCC_AHBENR_IOPFEN;
static const uint32_t apb1_voice = RCC_APB1ENR_TIM2EN | RCC_APB1ENR_USART2EN;

static uint8_t
all_on(volatile uint32_t *reg, uint32_t bits)
{
    return (*reg & bits) == bits;
}

/* Reading back is also the two cycles' wait until a clock is there (RM0364). */
uint8_t
peripherals_start(void)
{
    RCC_AHBENR |= ahb_voice | ahb_other;
    RCC_APB1ENR |= apb1_voice | RCC_APB1ENR_PWREN;
    RCC_APB2ENR |= RCC_APB2ENR_SYSCFGEN;
    return peripherals_verify();
}

uint8_t
peripherals_verify(void)
{
    return peripherals_can_talk() && all_on(&RCC_AHBENR, ahb_other) && supervision_runs();
}

uint8_t
peripherals_can_talk(void)
{
    return all_on(&RCC_AHBENR, ahb_voice) && all_on(&RCC_APB1ENR, apb1_voice);
}

uint8_t
supervision_runs(void)
{
    return all_on(&RCC_APB1ENR, RCC_APB1ENR_PWREN) && all_on(&RCC_APB2ENR, RCC_APB2ENR_SYSCFGEN);
}

uint32_t
clock_hz(void)
{
    if ((RCC_CFGR & RCC_CFGR_SWS(3)) != RCC_CFGR_SWS(2))
        return 8000000;
    return RCC_CFGR & RCC_CFGR_PLLSRC ? 72000000 : 64000000;
}
