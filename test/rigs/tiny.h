/* Start-up and registers for images of a few lines, which show what the emulator does with each thing a chip can do.
 * Addresses from RM0364 and the ARMv7-M manual, apart from the firmware's header. */
#include <stdint.h>

#define R(address) (*(volatile uint32_t *)(address))
#define R8(address) (*(volatile uint8_t *)(address))
enum {
    RCC = 0x40021000, FLASH_ACR = 0x40022000, GPIOA = 0x48000000, GPIOB = 0x48000400, TIM2 = 0x40000000, TIM3 = 0x40000400,
    USART2 = 0x40004400, ADC = 0x50000000, DMA = 0x40020000, IWDG = 0x40003000, SPI1 = 0x40013000, CRC = 0x40023000,
    HRTIM = 0x40017400, HRTIM_COMMON = 0x40017780,
};
#define SYST 0xe000e010u
#define NVIC 0xe000e100u
#define SCB 0xe000ed00u

extern uint32_t _stack_top;
volatile uint32_t result[16];
void program(void);

static inline void wait(int n)
{
    while (n--)
        __asm__ volatile("");
}
static inline void wfi(void)
{
    __asm__ volatile("wfi");
}
/* 8 MHz from the debugger's clock, times 9; APB1 at half. */
static inline void clock_72(void)
{
    R(RCC) |= 1 << 18;
    R(RCC) |= 1 << 16;
    while (!(R(RCC) & 1 << 17))
        ;
    R(FLASH_ACR) = 0x12;
    R(RCC + 4) = 7 << 18 | 1 << 16 | 4 << 8;
    R(RCC) |= 1 << 24;
    while (!(R(RCC) & 1 << 25))
        ;
    R(RCC + 4) |= 2;
}
static inline void clocks_on(void)
{
    R(RCC + 0x14) |= 1 << 28 | 1 << 18 | 1 << 17 | 1 << 6 | 1;
    R(RCC + 0x1c) |= 1 << 28 | 1 << 17 | 3;
    R(RCC + 0x18) |= 1 << 29 | 1 << 12 | 1;
}
static inline void adc_regulator(void)
{
    R(ADC + 8) = 0;
    R(ADC + 8) = 1 << 28;
    wait(2000);
    R(ADC + 0x308) = 1 << 16;
}
static inline void adc_start(void)
{
    R(ADC + 8) |= 1u << 31;
    while (R(ADC + 8) >> 31)
        ;
    wait(20);
    R(ADC + 8) |= 1;
    while (!(R(ADC) & 1))
        ;
}
static inline void adc_on(void)
{
    adc_regulator();
    adc_start();
}
static inline void dll_on(void)
{
    R(RCC + 0x30) |= 1 << 12;
    R(HRTIM_COMMON + 0x4c) = 1;
    while (!(R(HRTIM_COMMON + 8) & 1 << 16))
        ;
}
/* Two legs, the second reset by the master's compare 1, which sets the lag; 120 kHz. */
static inline void legs(uint32_t lag)
{
    R(GPIOA + 0x24) = 0xdddd;
    R(GPIOA) = (R(GPIOA) & ~0xff0000u) | 0xaa0000u;
    R(HRTIM + 0x14) = 38400;
    R(HRTIM + 0x1c) = lag;
    R(HRTIM) = 8 | 1 << 27 | 1 << 29;
    for (int t = 1; t < 3; t++) {
        uint32_t base = HRTIM + 0x80 * t;
        R(base + 0x14) = 38400;
        R(base + 0x1c) = 19200;
        R(base + 0x38) = 0x00400040;
        R(base + 0x64) = 1 << 8;
        R(base + 0x3c) = 4;
        R(base + 0x40) = 8;
        R(base + 0x54) = t == 1 ? 1 << 4 : 1 << 5;
        R(base) = 8 | 1 << 27 | 1 << 18;
    }
    R(HRTIM_COMMON + 4) = 7;
    R(HRTIM) |= 7 << 16;
}

void start(void);
void start(void)
{
    for (int i = 0; i < 16; i++)
        result[i] = 0;
    program();
    for (;;)
        wfi();
}
/* A handler that a program does not define is vector 0, which the emulator objects to. */
__attribute__((weak)) void on_systick(void);
__attribute__((weak)) void on_tim2(void);
__attribute__((weak)) void on_tim3(void);
__attribute__((weak)) void on_usart2(void);
__attribute__((weak)) void on_dma1(void);
__attribute__((weak)) void on_hrtim_fault(void);
__attribute__((section(".vectors"), used)) const void *const vectors[16 + 82] = {
    &_stack_top, start, [15] = on_systick, [16 + 11] = on_dma1, [16 + 28] = on_tim2, [16 + 29] = on_tim3,
    [16 + 38] = on_usart2, [16 + 73] = on_hrtim_fault,
};
