/* Interrupt controller and system control space of a Cortex-M4: NVIC, SCB, SysTick, DWT cycle counter.
 *
 * Source: ARMv7-M Architecture Reference Manual (DDI 0403), chapters B1.5 and B3; PM0214. Exceptions are numbered as
 * in the vector table. Four priority bits, as on STM32.
 */
#include <string.h>

#include "core.h"

enum { PRIORITY_BITS = 0xf0, IDLE_PRIORITY = 256, EXC_COUNT = EMULATOR_VECTORS, WORDS = EXC_COUNT / 32 };

static struct {
    uint32_t pending[WORDS], enabled[WORDS], active[WORDS];
    uint8_t line[EXC_COUNT];
    uint8_t priority[EXC_COUNT];
    uint64_t pended_at[EXC_COUNT];
    uint8_t stack[EXC_COUNT]; /* active exceptions, the newest last */
    int depth;
    uint32_t vtor, aircr, scr, ccr, shcsr, cpacr, fpccr, fpcar, fpdscr, demcr, dwt_ctrl;
    uint64_t cycles_from;     /* DWT counts from here */
    uint32_t cycles_base;
    uint32_t systick_ctrl, systick_load;
    uint64_t systick_zero_at; /* when the counter last was (or will first be) at its reload value */
    uint8_t systick_flag;
} n;

static void systick_wrap(void *arg);
static struct event systick_event = { .due = NEVER, .run = systick_wrap };

static int bit(const uint32_t *map, int i)
{
    return (int)(map[i >> 5] >> (i & 31) & 1u);
}

static void set(uint32_t *map, int i, int value)
{
    if (value)
        map[i >> 5] |= 1u << (i & 31);
    else
        map[i >> 5] &= ~(1u << (i & 31));
}

void nvic_reset(void)
{
    memset(&n, 0, sizeof n);
    n.enabled[0] = 0xffffu; /* system exceptions cannot be disabled here */
    n.vtor = 0;
    n.aircr = 0;
    n.ccr = 0x200;
    n.fpccr = 0xc0000000u;
    event_at(&systick_event, NEVER);
}

/* ---- priorities ----------------------------------------------------------------------------- */

void nvic_pend(int exception)
{
    if (!bit(n.pending, exception))
        n.pended_at[exception] = now();
    set(n.pending, exception, 1);
}

void nvic_line(unsigned irq, int level)
{
    int exception = EXC_IRQ0 + (int)irq;
    if (level && !n.line[exception])
        nvic_pend(exception);
    n.line[exception] = level != 0;
}

static int group_priority(int exception)
{
    if (exception < 4)
        return exception - 4;
    uint32_t group = n.aircr >> 8 & 7u;
    return n.priority[exception % EXC_COUNT] & ~((2u << group) - 1u) & 0xff;
}

static int active_priority(void)
{
    int best = IDLE_PRIORITY;
    for (int i = 0; i < n.depth; i++) {
        int p = group_priority(n.stack[i]);
        best = p < best ? p : best;
    }
    return best;
}

int nvic_any_pending(void)
{
    uint32_t any = 0;
    for (int w = 0; w < WORDS; w++)
        any |= n.pending[w] & n.enabled[w];
    return any != 0;
}

/* The pending exception of the highest priority; the lowest number among equals. */
static int best_pending(int *priority)
{
    int best = 0, best_level = IDLE_PRIORITY, best_sub = 0;
    for (int w = 0; w < WORDS; w++)
        for (uint32_t map = n.pending[w] & n.enabled[w]; map; map &= map - 1) {
            int e = w * 32 + __builtin_ctz(map);
            int level = group_priority(e), sub = n.priority[e];
            if (level < best_level || (level == best_level && sub < best_sub)) {
                best = e;
                best_level = level;
                best_sub = sub;
            }
        }
    *priority = best_level;
    return best;
}

int nvic_next(uint32_t primask, uint32_t basepri, uint32_t faultmask)
{
    int level, e = best_pending(&level);
    int limit = active_priority();
    if (basepri && (int)(basepri & PRIORITY_BITS) < limit)
        limit = (int)(basepri & PRIORITY_BITS);
    if (primask && limit > 0)
        limit = 0;
    if (faultmask && limit > -1)
        limit = -1;
    return e && level < limit ? e : 0;
}

/* WFI ends with an exception that would preempt but for PRIMASK. */
int nvic_wake(void)
{
    return nvic_next(0, 0, 0) != 0;
}

void nvic_enter(int exception)
{
    set(n.pending, exception, 0);
    set(n.active, exception, 1);
    n.stack[n.depth++] = (uint8_t)exception;
}

void nvic_leave(int exception)
{
    n.depth--;
    set(n.active, exception, 0);
    if (n.line[exception])
        nvic_pend(exception);
}

int nvic_active_count(void)
{
    return n.depth;
}

int nvic_top_active(void)
{
    return n.depth ? n.stack[n.depth - 1] : 0;
}

uint64_t nvic_pended_at(int exception)
{
    return n.pended_at[exception];
}

uint32_t nvic_vector_table(void)
{
    return n.vtor;
}

/* ---- SysTick: counts down with the processor clock ------------------------------------------- */

static uint64_t systick_period(void)
{
    return (uint64_t)n.systick_load + 1;
}

static void systick_wrap(void *arg)
{
    (void)arg;
    n.systick_flag = 1;
    if (n.systick_ctrl & 2u)
        nvic_pend(EXC_SYSTICK);
    n.systick_zero_at += systick_period();
    event_at(&systick_event, n.systick_zero_at);
}

static void systick_start(void)
{
    n.systick_zero_at = now() + systick_period();
    event_at(&systick_event, n.systick_ctrl & 1u && n.systick_load ? n.systick_zero_at : NEVER);
}

static uint32_t systick_read(uint32_t address)
{
    uint32_t value;
    switch (address & 0xf) {
    case 0x0:
        value = n.systick_ctrl | (uint32_t)n.systick_flag << 16;
        n.systick_flag = 0;
        return value;
    case 0x4:
        return n.systick_load;
    case 0x8:
        if (!(n.systick_ctrl & 1u) || !n.systick_load)
            return 0;
        return now() < n.systick_zero_at ? (uint32_t)(n.systick_zero_at - now() - 1) : 0;
    default:
        return 0x40000000u; /* CALIB: no exact reference */
    }
}

static void systick_write(uint32_t address, uint32_t value)
{
    if ((address & 0xf) == 0x0) {
        if (!(value & 4u) && value & 1u)
            fault("SysTick from the eighth of the processor clock is not modelled (SYST_CSR = 0x%x)", value);
        int starts = value & 1u && !(n.systick_ctrl & 1u);
        n.systick_ctrl = value & 7u;
        if (starts || !(value & 1u))
            systick_start();
    } else if ((address & 0xf) == 0x4) {
        n.systick_load = value & 0xffffffu;
    } else if ((address & 0xf) == 0x8) {
        n.systick_flag = 0;
        systick_start();
    }
}

/* ---- NVIC registers ---------------------------------------------------------------------------- */

static uint32_t irq_word(const uint32_t *map, int word)
{
    uint32_t value = 0;
    for (int i = 0; i < 32; i++) {
        int e = EXC_IRQ0 + word * 32 + i;
        if (e < EXC_COUNT)
            value |= (uint32_t)bit(map, e) << i;
    }
    return value;
}

static void irq_word_write(uint32_t *map, int word, uint32_t value, int to, const char *what)
{
    for (int i = 0; i < 32; i++) {
        int e = EXC_IRQ0 + word * 32 + i;
        if (!(value >> i & 1u) || e >= EXC_COUNT)
            continue;
        if (!chip_irq_exists((unsigned)(e - EXC_IRQ0))) {
            if (to)
                fault("%s of interrupt %d, which this chip does not have", what, e - EXC_IRQ0);
            continue;
        }
        if (map == n.pending && to)
            nvic_pend(e);
        if (map == n.enabled && to && !bit(map, e))
            n.pended_at[e] = now(); /* waiting counts from here */
        set(map, e, to);
        if (map == n.pending && !to && n.line[e])
            nvic_pend(e); /* the peripheral still asks */
    }
}

static uint32_t nvic_read(uint32_t offset)
{
    int word = (int)(offset >> 2 & 7u);
    if (word >= 3 && offset < 0x300)
        return 0;
    if (offset < 0x100)
        return irq_word(n.enabled, word);
    if (offset < 0x200)
        return irq_word(n.pending, word);
    if (offset < 0x300)
        return irq_word(n.active, word);
    uint32_t first = offset - 0x300, value = 0;
    for (uint32_t i = 0; i < 4; i++)
        if (EXC_IRQ0 + first + i < EXC_COUNT)
            value |= (uint32_t)n.priority[EXC_IRQ0 + first + i] << (8 * i);
    return value;
}

static void nvic_write(uint32_t offset, uint32_t value)
{
    int word = (int)(offset >> 2 & 7u);
    if (offset < 0x300 && word >= 3) {
        if (value)
            fault("a write to an interrupt set of the NVIC that this chip does not have (0x%x)", 0xe000e100u + offset);
        return;
    }
    if (offset < 0x80)
        irq_word_write(n.enabled, word, value, 1, "enabling");
    else if (offset < 0x100)
        irq_word_write(n.enabled, word, value, 0, "disabling");
    else if (offset < 0x180)
        irq_word_write(n.pending, word, value, 1, "pending");
    else if (offset < 0x200)
        irq_word_write(n.pending, word, value, 0, "clearing");
    else if (offset < 0x300)
        fault("a write to the read-only active bits of the NVIC");
    else
        for (uint32_t i = 0; i < 4; i++)
            if (EXC_IRQ0 + offset - 0x300 + i < EXC_COUNT)
                n.priority[EXC_IRQ0 + offset - 0x300 + i] = (uint8_t)(value >> (8 * i) & PRIORITY_BITS);
}

/* ---- system control block ---------------------------------------------------------------------- */

enum {
    CPUID = 0xd00, ICSR = 0xd04, VTOR = 0xd08, AIRCR = 0xd0c, SCR = 0xd10, CCR = 0xd14, SHPR1 = 0xd18, SHPR3 = 0xd20,
    SHCSR = 0xd24, CFSR = 0xd28, HFSR = 0xd2c, MMFAR = 0xd34, BFAR = 0xd38, AFSR = 0xd3c, CPACR = 0xd88, DEMCR = 0xdfc,
    FPCCR = 0xf34, FPCAR = 0xf38, FPDSCR = 0xf3c,
};

static uint32_t icsr_read(void)
{
    int level, e = best_pending(&level);
    uint32_t value = (uint32_t)nvic_top_active() | (uint32_t)e << 12;
    value |= n.depth <= 1 ? 1u << 11 : 0;
    value |= e >= EXC_IRQ0 ? 1u << 22 : 0;
    value |= (uint32_t)bit(n.pending, EXC_SYSTICK) << 26 | (uint32_t)bit(n.pending, EXC_PENDSV) << 28;
    return value;
}

static void icsr_write(uint32_t value)
{
    if (value & 1u << 31)
        nvic_pend(EXC_NMI);
    if (value & 1u << 28)
        nvic_pend(EXC_PENDSV);
    if (value & 1u << 27)
        set(n.pending, EXC_PENDSV, 0);
    if (value & 1u << 26)
        nvic_pend(EXC_SYSTICK);
    if (value & 1u << 25)
        set(n.pending, EXC_SYSTICK, 0);
}

static uint32_t shpr_read(uint32_t offset)
{
    uint32_t value = 0;
    for (uint32_t i = 0; i < 4; i++)
        value |= (uint32_t)n.priority[offset - SHPR1 + 4 + i] << (8 * i);
    return value;
}

static uint32_t scb_read(uint32_t offset)
{
    switch (offset) {
    case CPUID:
        return 0x410fc241u;
    case ICSR:
        return icsr_read();
    case VTOR:
        return n.vtor;
    case AIRCR:
        return 0xfa050000u | n.aircr;
    case SCR:
        return n.scr;
    case CCR:
        return n.ccr;
    case SHCSR:
        return n.shcsr;
    case CFSR:
    case HFSR:
    case MMFAR:
    case BFAR:
    case AFSR:
        return 0; /* whatever would set them is a fault of the model */
    case CPACR:
        return n.cpacr;
    case DEMCR:
        return n.demcr;
    case FPCCR:
        return n.fpccr;
    case FPCAR:
        return n.fpcar;
    case FPDSCR:
        return n.fpdscr;
    default:
        if (offset >= SHPR1 && offset <= SHPR3)
            return shpr_read(offset);
        if (offset >= 0xd40 && offset < 0xd80)
            return 0; /* identification registers, which no firmware needs */
        fault("a read of the system control space at 0xe000e%03x, which is not modelled", offset);
        return 0;
    }
}

static void aircr_write(uint32_t value)
{
    if (value >> 16 != 0x5fau) {
        fault("AIRCR written without its key 0x05fa (value 0x%08x): the write has no effect", value);
        return;
    }
    n.aircr = value & 0x700u;
    if (value & 4u)
        core_reset(RESET_SOFTWARE);
}

static void scb_write(uint32_t offset, uint32_t value)
{
    switch (offset) {
    case ICSR:
        icsr_write(value);
        return;
    case VTOR:
        if (value & 0x1ffu)
            fault("VTOR = 0x%08x: the vector table must be aligned to 512 bytes", value);
        n.vtor = value;
        return;
    case AIRCR:
        aircr_write(value);
        return;
    case SCR:
        if (value & 4u)
            fault("deep sleep (SCR = 0x%x) is not modelled", value);
        n.scr = value;
        return;
    case CCR:
        n.ccr = value;
        return;
    case SHCSR:
        n.shcsr = value;
        return;
    case CFSR:
    case HFSR:
        return; /* write one to clear */
    case CPACR:
        n.cpacr = value;
        return;
    case DEMCR:
        n.demcr = value;
        return;
    case FPCCR:
        n.fpccr = value;
        return;
    case FPCAR:
        n.fpcar = value;
        return;
    case FPDSCR:
        n.fpdscr = value;
        return;
    default:
        if (offset >= SHPR1 && offset <= SHPR3 + 3) {
            for (uint32_t i = 0; i < 4; i++)
                n.priority[offset - SHPR1 + 4 + i] = (uint8_t)(value >> (8 * i) & PRIORITY_BITS);
            return;
        }
        fault("a write to the system control space at 0xe000e%03x, which is not modelled", offset);
    }
}

/* ---- DWT ------------------------------------------------------------------------------------- */

static uint32_t cycles(void)
{
    return n.dwt_ctrl & 1u ? n.cycles_base + (uint32_t)(now() - n.cycles_from) : n.cycles_base;
}

static uint32_t dwt_read(uint32_t offset)
{
    if (!(n.demcr & 1u << 24))
        fault("the DWT is read while DEMCR.TRCENA is off: it does not count then");
    if (offset == 0)
        return n.dwt_ctrl | 0x40000000u;
    if (offset == 4)
        return cycles();
    fault("a read of the DWT at 0xe0001%03x, which is not modelled", offset);
    return 0;
}

static void dwt_write(uint32_t offset, uint32_t value)
{
    if (!(n.demcr & 1u << 24))
        fault("the DWT is written while DEMCR.TRCENA is off");
    uint32_t count = cycles();
    if (offset == 0) {
        if (value & ~1u & 0x0fffffffu)
            fault("DWT_CTRL = 0x%08x: only the cycle counter is modelled", value);
        n.dwt_ctrl = value & 1u;
    } else if (offset == 4) {
        count = value;
    } else if (offset != 0xfb0) { /* the lock access register does nothing here */
        fault("a write to the DWT at 0xe0001%03x, which is not modelled", offset);
    }
    n.cycles_base = count;
    n.cycles_from = now();
}

/* ---- private peripheral bus ---------------------------------------------------------------------- */

uint32_t ppb_read(uint32_t address)
{
    uint32_t offset = address & 0xfffu;
    if (address >> 12 == 0xe0001u)
        return dwt_read(offset);
    if (address >> 12 == 0xe0042u)
        return chip_read(address, 4);
    if (address >> 12 != 0xe000eu) {
        fault("a read at 0x%08x on the private peripheral bus, which is not modelled", address);
        return 0;
    }
    if (offset >= 0x10 && offset < 0x20)
        return systick_read(address);
    if (offset >= 0x100 && offset < 0x500)
        return nvic_read(offset - 0x100);
    if (offset == 0x4)
        return 3; /* ICTR: 96 to 128 lines */
    return scb_read(offset);
}

void ppb_write(uint32_t address, uint32_t value)
{
    uint32_t offset = address & 0xfffu;
    if (address >> 12 == 0xe0001u) {
        dwt_write(offset, value);
    } else if (address >> 12 == 0xe0042u) {
        chip_write(address, value, 4);
    } else if (address >> 12 != 0xe000eu) {
        fault("a write to 0x%08x on the private peripheral bus, which is not modelled", address);
    } else if (offset >= 0x10 && offset < 0x20) {
        systick_write(address, value);
    } else if (offset >= 0x100 && offset < 0x500) {
        nvic_write(offset - 0x100, value);
    } else if (offset == 0xf00) {
        nvic_pend(EXC_IRQ0 + (int)(value & 0x1ffu));
    } else {
        scb_write(offset, value);
    }
}
