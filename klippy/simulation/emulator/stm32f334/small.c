/* PWR, IWDG, CRC, SYSCFG, EXTI, DBGMCU: RM0364 chapters 7, 24, 6, 10, 12, 30. */
#include "chip.h"

#include <string.h>

/* ---- PWR: the supply voltage detector --------------------------------------------------------------------- */

static uint32_t pwr_cr, syscfg_cfgr2;

uint32_t pwr_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    if (offset == 0)
        return pwr_cr;
    if (offset == 4)
        return pwr_cr & 1u << 4 && mutation.brown_out ? 1u << 2 : 0;
    return unmodelled_read("PWR", offset);
}

void pwr_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    if (offset) {
        unmodelled_write("PWR", offset, value);
        return;
    }
    must_be("PWR", "CR", value, 0x1fcu);
    if (value & 2u)
        fault("standby is not modelled (PWR_CR = 0x%x)", value);
    pwr_cr = value;
}

void pwr_reset(unsigned unit)
{
    (void)unit;
    pwr_cr = 0;
}

int pwr_system_fault(void)
{
    return (pwr_cr & 1u << 4) && (syscfg_cfgr2 & 1u << 2);
}

/* ---- IWDG --------------------------------------------------------------------------------------------------- */

enum { LSI_HZ = 40000, RELOAD = 0xaaaa, UNLOCK = 0x5555, START = 0xcccc };

static struct { uint32_t prescaler, reload; int open, runs; struct event due; } dog;

static void dog_bites(void *arg)
{
    (void)arg;
    core_reset(RESET_WATCHDOG);
}

static void dog_feed(void)
{
    uint64_t counts = (uint64_t)(dog.reload + 1) * (4u << (dog.prescaler > 6 ? 6 : dog.prescaler));
    if (dog.runs)
        event_at(&dog.due, now() + counts * CORE_TICK_HZ / LSI_HZ);
}

uint32_t iwdg_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    switch (offset) {
    case 0x00:
        return 0;
    case 0x04:
        return dog.prescaler;
    case 0x08:
        return dog.reload;
    case 0x0c:
        return 0; /* updates take no time here */
    default:
        return unmodelled_read("IWDG", offset);
    }
}

void iwdg_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    if (offset == 0) {
        dog.open = value == UNLOCK;
        if (value == START)
            dog.runs = 1;
        if (value == START || value == RELOAD)
            dog_feed();
        if (value != START && value != RELOAD && value != UNLOCK && value)
            fault("IWDG_KR = 0x%x is none of its keys", value);
        return;
    }
    if (!dog.open)
        fault("IWDG + 0x%02x is written without the key 0x5555", offset);
    if (offset == 4)
        dog.prescaler = value & 7u;
    else if (offset == 8)
        dog.reload = value & 0xfffu;
    else
        unmodelled_write("IWDG", offset, value);
}

void iwdg_reset(unsigned unit)
{
    (void)unit;
    dog.prescaler = 0;
    dog.reload = 0xfff;
    dog.open = dog.runs = 0;
    dog.due.run = dog_bites;
    event_at(&dog.due, NEVER);
}

/* ---- CRC ---------------------------------------------------------------------------------------------------- */

/* `value` stands left: its highest bit is bit 31 whatever the size. */
static struct { uint32_t value, init, poly, cr, idr; } crc;

/* CR.POLYSIZE */
static unsigned crc_bits(void)
{
    static const uint8_t bits[] = { 32, 16, 8, 7 };
    return bits[crc.cr >> 3 & 3u];
}

static uint32_t mirror(uint32_t value, unsigned bits)
{
    uint32_t out = 0;
    for (unsigned i = 0; i < bits; i++)
        out |= (value >> i & 1u) << (bits - 1 - i);
    return out;
}

/* CR.REV_IN: 1 by byte, 2 by half word, 3 by word. */
static uint32_t reverse_in(uint32_t value, unsigned bits)
{
    unsigned mode = crc.cr >> 5 & 3u, unit = mode == 0 ? 0 : mode == 1 ? 8 : mode == 2 ? 16 : 32;
    if (!unit)
        return value;
    unit = unit > bits ? bits : unit;
    uint32_t out = 0;
    for (unsigned i = 0; i < bits; i += unit)
        out |= mirror(unit == 32 ? value : value >> i & ((1u << unit) - 1u), unit) << i;
    return out;
}

static void crc_feed(uint32_t value, unsigned bits)
{
    value = reverse_in(value, bits);
    for (unsigned i = bits; i-- > 0;) {
        uint32_t top = (crc.value >> 31 ^ value >> i) & 1u;
        crc.value = crc.value << 1 ^ (top ? crc.poly << (32 - crc_bits()) : 0);
    }
}

static uint32_t crc_result(void)
{
    uint32_t value = crc.value >> (32 - crc_bits());
    return crc.cr & 1u << 7 ? mirror(value, crc_bits()) : value;
}

uint32_t crc_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    switch (offset) {
    case 0x00:
        return crc_result();
    case 0x04:
        return crc.idr;
    case 0x08:
        return crc.cr;
    case 0x10:
        return crc.init;
    case 0x14:
        return crc.poly;
    default:
        return unmodelled_read("CRC", offset);
    }
}

void crc_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    unsigned narrow = offset >> 28;
    switch (offset & 0xfffu) {
    case 0x00:
        crc_feed(value, narrow ? 8 * narrow : 32);
        return;
    case 0x04:
        crc.idr = value & 0xffu;
        return;
    case 0x08:
        must_be("CRC", "CR", value, 0xf9u);
        crc.cr = value & 0xf8u;
        if (value & 1u)
            crc.value = crc.init << (32 - crc_bits());
        return;
    case 0x10:
        crc.init = value;
        crc.value = value << (32 - crc_bits());
        return;
    case 0x14:
        crc.poly = value;
        return;
    default:
        unmodelled_write("CRC", offset, value);
    }
}

void crc_reset(unsigned unit)
{
    (void)unit;
    crc.value = crc.init = 0xffffffffu;
    crc.poly = 0x04c11db7u;
    crc.cr = crc.idr = 0;
}

/* ---- SYSCFG ------------------------------------------------------------------------------------------------- */

static uint32_t cfgr1, cfgr3, exticr[4], rcr;

uint32_t syscfg_remap(void)
{
    return cfgr1;
}

uint32_t syscfg_remap3(void)
{
    return cfgr3;
}

uint32_t syscfg_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    switch (offset) {
    case 0x00:
        return cfgr1;
    case 0x04:
        return rcr;
    case 0x18:
        return syscfg_cfgr2;
    case 0x50:
        return cfgr3;
    default:
        if (offset >= 0x08 && offset <= 0x14)
            return exticr[(offset - 8) / 4];
        return unmodelled_read("SYSCFG", offset);
    }
}

void syscfg_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    switch (offset) {
    case 0x00:
        if (value & 2u)
            fault("SYSCFG MEM_MODE = %u: SRAM at address 0 is not modelled", value & 3u);
        cfgr1 = value;
        return;
    case 0x04:
        rcr = value;
        return;
    case 0x18:
        must_be("SYSCFG", "CFGR2", value, 0x117u);
        syscfg_cfgr2 |= value & 0x17u; /* locks stay until the next reset */
        hrtim_fault_line();
        return;
    case 0x50:
        must_be("SYSCFG", "CFGR3", value, 0x3ffu);
        cfgr3 = value;
        return;
    default:
        if (offset >= 0x08 && offset <= 0x14)
            exticr[(offset - 8) / 4] = value;
        else
            unmodelled_write("SYSCFG", offset, value);
    }
}

void syscfg_reset(unsigned unit)
{
    (void)unit;
    cfgr1 = syscfg_cfgr2 = rcr = 0;
    cfgr3 = 0x200u;
    memset(exticr, 0, sizeof exticr);
}

/* ---- EXTI: only line 16, the voltage detector -------------------------------------------------------------- */

static uint32_t exti_mask, exti_rise, exti_fall, exti_pending;

uint32_t exti_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    switch (offset) {
    case 0x00:
        return exti_mask | 0x1f800000u;
    case 0x04:
        return 0;
    case 0x08:
        return exti_rise;
    case 0x0c:
        return exti_fall;
    case 0x14:
        return exti_pending;
    default:
        return unmodelled_read("EXTI", offset);
    }
}

void exti_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    if (offset <= 0x0c && value & 0x7effffu)
        fault("EXTI + 0x%02x = 0x%x: interrupts of pins are not modelled", offset, value);
    if (offset == 0x00)
        exti_mask = value;
    else if (offset == 0x08)
        exti_rise = value;
    else if (offset == 0x0c)
        exti_fall = value;
    else if (offset == 0x14)
        exti_pending &= ~value;
    else if (value)
        unmodelled_write("EXTI", offset, value);
}

void exti_reset(unsigned unit)
{
    (void)unit;
    exti_mask = exti_rise = exti_fall = exti_pending = 0;
}

/* ---- DBGMCU --------------------------------------------------------------------------------------------------- */

static uint32_t dbg[4];

uint32_t dbgmcu_read(unsigned unit, uint32_t offset)
{
    (void)unit;
    if (offset == 0)
        return 0x10016438u;
    return offset < 0x10 ? dbg[offset / 4] : unmodelled_read("DBGMCU", offset);
}

void dbgmcu_write(unsigned unit, uint32_t offset, uint32_t value)
{
    (void)unit;
    if (offset && offset < 0x10)
        dbg[offset / 4] = value;
    else
        unmodelled_write("DBGMCU", offset, value);
}

void dbgmcu_reset(unsigned unit)
{
    (void)unit;
    memset(dbg, 0, sizeof dbg);
}
