/* RCC and FLASH: the clock tree (RM0364 chapters 8 and 3). */
#include "chip.h"

#include <string.h>

enum {
    CR = 0x00, CFGR = 0x04, CIR = 0x08, APB2RSTR = 0x0c, APB1RSTR = 0x10, BDCR = 0x20, CSR = 0x24, AHBRSTR = 0x28,
    CFGR2 = 0x2c, CFGR3 = 0x30,
    HSI_HZ = 8000000, HSE_HZ = 8000000, /* the Nucleo board's clock from its debugger */
    HSE_TICKS = 72000,   /* DS9994 table 41: start-up about 2 ms at most; here 1 ms */
    PLL_TICKS = 14400,   /* table 45: lock time 200 us at most */
    LSI_TICKS = 6000,    /* table 44: 85 us at most */
};

static struct {
    uint32_t cr, cfgr, cir, enable[3], bdcr, csr, cfgr2, cfgr3; /* enable: AHB, APB2, APB1 */
    uint64_t hse_at, pll_at, lsi_at;
} r;

static uint32_t flash_acr;
struct clocks clocks;

double ticks_of(uint32_t cycles, uint32_t hz)
{
    return (double)cycles * CORE_TICK_HZ / hz;
}

static int hse_ready(void)
{
    return r.cr & 1u << 16 && !mutation.no_crystal && now() >= r.hse_at;
}

static uint32_t pll_hz(void)
{
    uint32_t in = r.cfgr & 1u << 16 ? HSE_HZ / ((r.cfgr2 & 15u) + 1) : HSI_HZ / 2;
    uint32_t factor = (r.cfgr >> 18 & 15u) + 2;
    return in * (factor > 16 ? 16 : factor);
}

static int pll_ready(void)
{
    return r.cr & 1u << 24 && !mutation.no_pll && now() >= r.pll_at;
}

static uint32_t apb_divider(uint32_t code)
{
    return code < 4 ? 1 : 2u << (code - 4);
}

static void check_limits(void)
{
    uint32_t states = flash_acr & 7u, needed = clocks.hclk > 48000000 ? 2 : clocks.hclk > 24000000 ? 1 : 0;
    if (clocks.hclk > 72000000)
        fault("the processor clock is %u Hz; the maximum is 72 MHz (DS9994)", clocks.hclk);
    if (states < needed)
        fault("FLASH_ACR asks for %u wait states at %u Hz, which needs %u (RM0364, 3.5.1)", states, clocks.hclk, needed);
    if (clocks.pclk1 > 36000000)
        fault("APB1 runs at %u Hz; the maximum is 36 MHz", clocks.pclk1);
}

static void recalculate(void)
{
    static const uint8_t HPRE[8] = { 1, 2, 3, 4, 6, 7, 8, 9 };
    static const uint16_t ADC_DIVIDER[16] = { 1, 2, 4, 6, 8, 10, 12, 16, 32, 64, 128, 256, 256, 256, 256, 256 };
    if (clocks.hclk)
        timer_before_clock_change();
    uint32_t source = r.cfgr & 3u, code = r.cfgr >> 4 & 15u;
    uint32_t system = source == 0 ? HSI_HZ : source == 1 ? HSE_HZ : pll_hz();
    clocks.hclk = code < 8 ? system : system >> HPRE[code - 8];
    uint32_t d1 = apb_divider(r.cfgr >> 8 & 7u), d2 = apb_divider(r.cfgr >> 11 & 7u);
    clocks.pclk1 = clocks.hclk / d1;
    clocks.pclk2 = clocks.hclk / d2;
    clocks.timer1 = clocks.pclk1 * (d1 > 1 ? 2 : 1);
    clocks.timer2 = clocks.pclk2 * (d2 > 1 ? 2 : 1);
    clocks.hrtim = r.cfgr3 & 1u << 12 ? 2 * pll_hz() : clocks.timer2;
    clocks.usart1 = (r.cfgr3 & 3u) == 1 ? system : (r.cfgr3 & 3u) == 3 ? HSI_HZ : clocks.pclk1;
    uint32_t adc = r.cfgr2 >> 4 & 31u;
    clocks.adc_async = adc & 16u ? pll_hz() / ADC_DIVIDER[adc & 15u] : 0;
    core_set_cpu_hz(clocks.hclk);
}

void rcc_power_on(uint32_t cause)
{
    memset(&r, 0, sizeof r);
    r.cr = 0x83u;
    r.enable[0] = 0x14u;
    /* Power-on and pin flags; a watchdog's or software's reset shows as such, with the pin flag (it pulls NRST). */
    r.csr = 1u << 26 | (cause == RESET_SOFTWARE ? 1u << 28 : cause == RESET_WATCHDOG ? 1u << 29 : 1u << 27);
    recalculate();
}

static uint32_t *enable_register(uint32_t offset)
{
    return &r.enable[offset == RCC_AHBENR ? 0 : offset == RCC_APB2ENR ? 1 : 2];
}

int rcc_enabled(uint16_t clock)
{
    if (mutation.clock_stuck && clock == mutation.clock_stuck)
        return 0;
    return (int)(*enable_register(clock >> 8) >> (clock & 0xff) & 1u);
}

static uint32_t cr_read(void)
{
    uint32_t value = r.cr & ~(1u << 17 | 1u << 25 | 2u);
    return value | (r.cr & 1u) << 1 | (uint32_t)hse_ready() << 17 | (uint32_t)pll_ready() << 25;
}

static uint32_t csr_read(void)
{
    return r.csr | (r.csr & 1u && now() >= r.lsi_at ? 2u : 0);
}

/* The crystal dies. With the clock security on (CSSON) the chip goes on from the HSI, raises the NMI and takes HRTIM's outputs
 * off (8.2.7); without it, the chip would stand still. */
void rcc_crystal_stops(void)
{
    mutation.no_crystal = 1;
    if ((r.cfgr & 3u) == 0 || (!(r.cfgr & 1u << 16) && (r.cfgr & 3u) == 2))
        return; /* runs from its own oscillator */
    if (!(r.cr & 1u << 19)) {
        core_halt("the crystal has stopped, and the clock security is off");
        return;
    }
    r.cr &= ~(1u << 16 | 1u << 24);
    r.cfgr &= ~3u;
    r.cir |= 1u << 7;
    recalculate();
    hrtim_system_fault();
    nvic_pend(EXC_NMI);
}

uint32_t rcc_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    switch (offset) {
    case CR:
        return cr_read();
    case CFGR:
        return (r.cfgr & ~12u) | (r.cfgr & 3u) << 2;
    case CIR:
        return r.cir;
    case RCC_AHBENR:
    case RCC_APB2ENR:
    case RCC_APB1ENR: {
        uint32_t value = *enable_register(offset);
        if (mutation.clock_stuck >> 8 == offset)
            value &= ~(1u << (mutation.clock_stuck & 0xff));
        return value;
    }
    case APB1RSTR:
    case APB2RSTR:
    case AHBRSTR:
        return 0;
    case BDCR:
        return r.bdcr;
    case CSR:
        return csr_read();
    case CFGR2:
        return r.cfgr2;
    case CFGR3:
        return r.cfgr3;
    default:
        return unmodelled_read("RCC", offset);
    }
}

static void cr_write(uint32_t value)
{
    if (!(value & 1u) && (r.cfgr & 3u) == 0)
        fault("the HSI is switched off while it is the system clock");
    if (value & 1u << 16 && !(r.cr & 1u << 16))
        r.hse_at = now() + HSE_TICKS;
    if (value & 1u << 24 && !(r.cr & 1u << 24)) {
        if (r.cfgr & 1u << 16 && !hse_ready() && !mutation.no_crystal)
            fault("the PLL is started from the HSE before HSERDY");
        r.pll_at = now() + PLL_TICKS;
    }
    if (!(value & 1u << 24) && (r.cfgr & 3u) == 2)
        fault("the PLL is switched off while it is the system clock");
    if (value & 1u << 18 && !(r.cr & 1u << 18) && r.cr & 1u << 16)
        fault("HSEBYP is set while the HSE is on (RM0364, 8.4.1: only with the HSE off)");
    r.cr = value;
}

static void cfgr_write(uint32_t value)
{
    uint32_t pll_bits = 0x003f0000u;
    if (r.cr & 1u << 24 && (value ^ r.cfgr) & pll_bits)
        fault("PLL source or factor are changed while the PLL is on");
    uint32_t source = value & 3u;
    if (source == 1 && !hse_ready())
        fault("the HSE becomes system clock before it is ready");
    if (source == 2 && !pll_ready())
        fault("the PLL becomes system clock before it has locked");
    if (source == 3)
        fault("RCC_CFGR SW = 3 does not exist");
    r.cfgr = value;
    recalculate();
    check_limits();
}

static void enable_write(uint32_t offset, uint32_t value)
{
    static const uint32_t EXISTS[3] = { 0x115e0055u, 0x20075801u, 0x36260833u };
    static const char *const NAMES[3] = { "AHBENR", "APB2ENR", "APB1ENR" };
    uint32_t *reg = enable_register(offset);
    must_be("RCC", NAMES[reg - r.enable], value, EXISTS[reg - r.enable]);
    *reg = value;
}

void rcc_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    switch (offset) {
    case CR:
        cr_write(value);
        return;
    case CFGR:
        cfgr_write(value);
        return;
    case CIR:
        r.cir = (value & 0x1f00u) | (value & 1u << 23 ? 0 : r.cir & 0x80u);
        if (value & 0x1f00u)
            fault("clock interrupts (RCC_CIR = 0x%x) are not modelled", value);
        return;
    case RCC_AHBENR:
    case RCC_APB2ENR:
    case RCC_APB1ENR:
        enable_write(offset, value);
        return;
    case APB1RSTR:
    case APB2RSTR:
    case AHBRSTR:
        if (value)
            fault("peripheral resets by the RCC are not modelled (0x%x to + 0x%02x)", value, offset);
        return;
    case BDCR:
        r.bdcr = value;
        return;
    case CSR:
        if (value & 1u && !(r.csr & 1u))
            r.lsi_at = now() + LSI_TICKS;
        r.csr = (value & 1u << 24 ? 0 : r.csr & 0xfe000000u) | (value & 1u);
        return;
    case CFGR2:
        r.cfgr2 = value;
        recalculate();
        return;
    case CFGR3:
        must_be("RCC", "CFGR3", value, 0x1113u);
        if (value & 1u << 12 && !(r.cr & 1u << 24))
            fault("HRTIM is given the doubled PLL clock while the PLL is off");
        r.cfgr3 = value;
        recalculate();
        return;
    default:
        unmodelled_write("RCC", offset, value);
    }
}

/* ---- FLASH: wait states; programming is not modelled ---------------------------------------------- */

void flash_reset(unsigned unit)
{
    (void)unit;
    flash_acr = 0x30u;
}

uint32_t flash_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    switch (offset) {
    case 0x00:
        return (flash_acr & 0x1fu) | (flash_acr & 0x10u) << 1;
    case 0x0c:
        return 0;
    case 0x10:
        return 0x80u;
    case 0x1c:
        return 0xffffff02u & ~0xffu;
    case 0x20:
        return 0xffffffffu;
    default:
        return unmodelled_read("FLASH", offset);
    }
}

void flash_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    if (offset) {
        fault("a write of 0x%x to FLASH + 0x%02x: programming the flash memory is not modelled", value, offset);
        return;
    }
    must_be("FLASH", "ACR", value, 0x3fu);
    flash_acr = value;
    check_limits();
}
