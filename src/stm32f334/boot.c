/* main(): the order in which the chip is brought up, and what it remembers of how it was found.
 *
 * The memory shows whether a power-on reset was only a dip of the supply: SRAM that still holds the mark of a running
 * firmware was never really without power.  Such a chip has stopped in the middle of
 * something, on a supply that does not hold; the bridge is refused until the host resets the chip once more by command.
 */
#include "board/irq.h"
#include "board/misc.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT_STR("MCU", "stm32f334");
DECL_CONSTANT("CLOCK_FREQ", PORT_CLOCK_HZ);

enum { REQUEST_BOOTLOADER = 0x626f6f74, MARK_RUNNING = 0x72756e73 };

extern volatile uint32_t boot_request[2];  /* link.ld; outlives a reset: [0] request, [1] mark of a running firmware */
extern uint32_t arena_start[], arena_end[];

void timer_start(void);
void console_start(void);
void bootloader_requested(void);
int main(void);

static uint8_t findings;

uint8_t
boot_findings(void)
{
    return findings;
}

/* Level 5 is about 2.7 V (DS9994): the last before the ADC's reference suffers. */
static void
watch_supply(void)
{
    if (!supervision_runs())
        return;
    PWR_CR = PWR_CR_PLS(5) | PWR_CR_PVDE;
    /* From now on a low supply, a parity error or a locked-up processor switch the bridge off by hardware. */
    SYSCFG_CFGR2 = SYSCFG_CFGR2_PVD_LOCK | SYSCFG_CFGR2_SRAM_PARITY_LOCK | SYSCFG_CFGR2_LOCKUP_LOCK;
}

uint8_t
supply_is_low(void)
{
    return !supervision_runs() || PWR_CSR & PWR_CSR_PVDO;
}

static uint8_t
was_brown_out(void)
{
    uint8_t dipped = RCC_CSR & RCC_CSR_PORRSTF && boot_request[1] == MARK_RUNNING;
    RCC_CSR |= RCC_CSR_RMVF;
    boot_request[1] = MARK_RUNNING;
    return dipped;
}

/****************************************************************
 * Reset and boot loader
 ****************************************************************/

void
board_reset(void)
{
    irq_disable();
    __asm__ volatile("dsb");
    SCB_AIRCR = SCB_AIRCR_SYSRESETREQ;
    for (;;)
        ;
}

/* Task context. */
void
bootloader_requested(void)
{
    irq_disable();
    boot_request[0] = REQUEST_BOOTLOADER;
    board_reset();
}

/* The ROM's own vector table (AN2606: STM32F334, system memory at 0x1fffd800).  The chip is as after a reset, and so it must
 * find it: its own oscillator, no watchdog, interrupts allowed. */
_Noreturn void
enter_rom_bootloader(void)
{
    const uint32_t *rom = (const uint32_t *)0x1fffd800u;
    boot_request[0] = 0;
    RCC_APB2ENR |= RCC_APB2ENR_SYSCFGEN;
    (void)RCC_APB2ENR;
    SYSCFG_CFGR1 = SYSCFG_CFGR1_MEM_MODE(1);
    __asm__ volatile("cpsie i\n msr msp, %0\n bx %1" ::"r"(rom[0]), "r"(rom[1]));
    __builtin_unreachable();
}

/****************************************************************
 * Board contract: memory
 ****************************************************************/

size_t
board_arena(void **start)
{
    *start = arena_start;
    return (uintptr_t)arena_end - (uintptr_t)arena_start;
}

uint32_t
board_peek(uint8_t order, uint32_t address)
{
    if (order == 0)
        return R8(address, 0);
    return order == 1 ? R16(address, 0) : R(address, 0);
}

void
board_poke(uint8_t order, uint32_t address, uint32_t value)
{
    if (order == 0)
        R8(address, 0) = (uint8_t)value;
    else if (order == 1)
        R16(address, 0) = (uint16_t)value;
    else
        R(address, 0) = value;
}

int
main(void)
{
    if (boot_request[0] == REQUEST_BOOTLOADER)
        enter_rom_bootloader();
    boot_request[0] = 0;
    if (!clock_start())
        findings |= BOOT_NO_CLOCK;
    if (!peripherals_start())
        findings |= BOOT_NO_CLOCK;
    while (!peripherals_can_talk())
        ; /* no report could be sent; no pin is an output yet */
    watch_supply();
    if (was_brown_out())
        findings |= BOOT_BROWN_OUT;
    if (!image_is_whole())
        findings |= BOOT_BAD_FLASH;
    message_crc_start();
    timer_start();
    console_start();
    sched_main();
    return 0;
}

void
boot_init(void)
{
    if (findings & BOOT_BAD_FLASH)
        shutdown(SHUTDOWN_FLASH_DAMAGED);
}
DECL_INIT(boot_init);
