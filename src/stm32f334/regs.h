/* Registers of the STM32F334 that this port uses, and no others.  Source: RM0364 (reference manual) and, for the last
 * section, PM0214 (Cortex-M4).  scripts/check/check_registers.py compares every address and bit with the vendor's SVD file.
 *
 *   NAME_BASE              a block's address
 *   NAME_REGISTER          a register: R(block, offset); with an argument where there are several such blocks
 *   NAME_REGISTER_FIELD    a bit: BIT(n); a field: FIELD(value, first bit, bits)
 */
#ifndef STM32F334_REGS_H
#define STM32F334_REGS_H

#include <stdint.h>

#define R(base, offset) (*(volatile uint32_t *)((base) + (offset)))
#define R16(base, offset) (*(volatile uint16_t *)((base) + (offset)))
#define R8(base, offset) (*(volatile uint8_t *)((base) + (offset)))
#define BIT(n) (1u << (n))
#define FIELD(value, first, bits) (((uint32_t)(value) & ((1u << (bits)) - 1u)) << (first))

/****************************************************************
 * Clocks, power, memory
 ****************************************************************/

#define RCC_BASE 0x40021000u
#define RCC_CR R(RCC_BASE, 0x00)
#define RCC_CR_HSION BIT(0)
#define RCC_CR_HSIRDY BIT(1)
#define RCC_CR_HSEON BIT(16)
#define RCC_CR_HSERDY BIT(17)
#define RCC_CR_HSEBYP BIT(18)
#define RCC_CR_CSSON BIT(19)
#define RCC_CR_PLLON BIT(24)
#define RCC_CR_PLLRDY BIT(25)
#define RCC_CFGR R(RCC_BASE, 0x04)
#define RCC_CFGR_SW(v) FIELD(v, 0, 2)
#define RCC_CFGR_SWS(v) FIELD(v, 2, 2)
#define RCC_CFGR_HPRE(v) FIELD(v, 4, 4)
#define RCC_CFGR_PPRE1(v) FIELD(v, 8, 3)
#define RCC_CFGR_PPRE2(v) FIELD(v, 11, 3)
#define RCC_CFGR_PLLSRC BIT(16)
#define RCC_CFGR_PLLMUL(v) FIELD(v, 18, 4)
#define RCC_CIR R(RCC_BASE, 0x08)
#define RCC_CIR_CSSF BIT(7)
#define RCC_CIR_CSSC BIT(23)
#define RCC_AHBENR R(RCC_BASE, 0x14)
#define RCC_AHBENR_DMAEN BIT(0)
#define RCC_AHBENR_SRAMEN BIT(2)
#define RCC_AHBENR_FLITFEN BIT(4)
#define RCC_AHBENR_CRCEN BIT(6)
#define RCC_AHBENR_IOPAEN BIT(17)
#define RCC_AHBENR_IOPBEN BIT(18)
#define RCC_AHBENR_IOPCEN BIT(19)
#define RCC_AHBENR_IOPDEN BIT(20)
#define RCC_AHBENR_IOPFEN BIT(22)
#define RCC_AHBENR_ADC12EN BIT(28)
#define RCC_APB2ENR R(RCC_BASE, 0x18)
#define RCC_APB2ENR_SYSCFGEN BIT(0)
#define RCC_APB2ENR_SPI1EN BIT(12)
#define RCC_APB2ENR_TIM15EN BIT(16)
#define RCC_APB2ENR_TIM16EN BIT(17)
#define RCC_APB2ENR_TIM17EN BIT(18)
#define RCC_APB2ENR_HRTIM1EN BIT(29)
#define RCC_APB1ENR R(RCC_BASE, 0x1c)
#define RCC_APB1ENR_TIM2EN BIT(0)
#define RCC_APB1ENR_TIM3EN BIT(1)
#define RCC_APB1ENR_USART2EN BIT(17)
#define RCC_APB1ENR_I2C1EN BIT(21)
#define RCC_APB1ENR_PWREN BIT(28)
#define RCC_CSR R(RCC_BASE, 0x24)
#define RCC_CSR_LSION BIT(0)
#define RCC_CSR_RMVF BIT(24)
#define RCC_CSR_PORRSTF BIT(27)
#define RCC_CSR_SFTRSTF BIT(28)
#define RCC_CSR_IWDGRSTF BIT(29)
#define RCC_CFGR2 R(RCC_BASE, 0x2c)
#define RCC_CFGR2_PREDIV(v) FIELD(v, 0, 4)
#define RCC_CFGR3 R(RCC_BASE, 0x30)
#define RCC_CFGR3_I2C1SW BIT(4)
#define RCC_CFGR3_HRTIM1SW BIT(12)

#define FLASH_BASE 0x40022000u
#define FLASH_ACR R(FLASH_BASE, 0x00)
#define FLASH_ACR_LATENCY(v) FIELD(v, 0, 3)
#define FLASH_ACR_PRFTBE BIT(4)
#define FLASH_ACR_PRFTBS BIT(5)

#define PWR_BASE 0x40007000u
#define PWR_CR R(PWR_BASE, 0x00)
#define PWR_CR_PVDE BIT(4)
#define PWR_CR_PLS(v) FIELD(v, 5, 3)
#define PWR_CSR R(PWR_BASE, 0x04)
#define PWR_CSR_PVDO BIT(2)

#define SYSCFG_BASE 0x40010000u
#define SYSCFG_CFGR1 R(SYSCFG_BASE, 0x00)
#define SYSCFG_CFGR1_MEM_MODE(v) FIELD(v, 0, 2)
#define SYSCFG_CFGR2 R(SYSCFG_BASE, 0x18)
#define SYSCFG_CFGR2_LOCKUP_LOCK BIT(0)
#define SYSCFG_CFGR2_SRAM_PARITY_LOCK BIT(1)
#define SYSCFG_CFGR2_PVD_LOCK BIT(2)

#define CRC_BASE 0x40023000u
#define CRC_DR R(CRC_BASE, 0x00)
#define CRC_CR R(CRC_BASE, 0x08)
#define CRC_CR_RESET BIT(0)
#define CRC_CR_POLYSIZE(v) FIELD(v, 3, 2)
#define CRC_CR_REV_IN(v) FIELD(v, 5, 2)
#define CRC_CR_REV_OUT BIT(7)
#define CRC_INIT R(CRC_BASE, 0x10)
#define CRC_POL R(CRC_BASE, 0x14)

#define IWDG_BASE 0x40003000u
#define IWDG_KR R(IWDG_BASE, 0x00)
#define IWDG_PR R(IWDG_BASE, 0x04)
#define IWDG_RLR R(IWDG_BASE, 0x08)
#define IWDG_SR R(IWDG_BASE, 0x0c)
#define IWDG_SR_PVU BIT(0)
#define IWDG_SR_RVU BIT(1)

/****************************************************************
 * Pins
 ****************************************************************/

#define GPIOA_BASE 0x48000000u
#define GPIO_STRIDE 0x400u
#define GPIO_MODER(gpio) R(gpio, 0x00)
#define GPIO_OTYPER(gpio) R(gpio, 0x04)
#define GPIO_OSPEEDR(gpio) R(gpio, 0x08)
#define GPIO_PUPDR(gpio) R(gpio, 0x0c)
#define GPIO_IDR(gpio) R(gpio, 0x10)
#define GPIO_ODR(gpio) R(gpio, 0x14)
#define GPIO_BSRR(gpio) R(gpio, 0x18)
#define GPIO_AFRL(gpio) R(gpio, 0x20)
#define GPIO_AFRH(gpio) R(gpio, 0x24)

/****************************************************************
 * Timers
 ****************************************************************/

#define TIM2_BASE 0x40000000u
#define TIM3_BASE 0x40000400u
#define TIM15_BASE 0x40014000u
#define TIM16_BASE 0x40014400u
#define TIM17_BASE 0x40014800u
#define TIM_CR1(tim) R(tim, 0x00)
#define TIM_CR1_CEN BIT(0)
#define TIM_CR1_ARPE BIT(7)
#define TIM_DIER(tim) R(tim, 0x0c)
#define TIM_DIER_CC1IE BIT(1)
#define TIM_SR(tim) R(tim, 0x10)
#define TIM_SR_CC1IF BIT(1)
#define TIM_EGR(tim) R(tim, 0x14)
#define TIM_EGR_UG BIT(0)
#define TIM_EGR_CC1G BIT(1)
#define TIM_CCMR1(tim) R(tim, 0x18)
#define TIM_CCMR1_OC1PE BIT(3)
#define TIM_CCMR1_OC1M(v) FIELD(v, 4, 3)
#define TIM_CCMR1_OC2PE BIT(11)
#define TIM_CCMR1_OC2M(v) FIELD(v, 12, 3)
#define TIM_CCMR2(tim) R(tim, 0x1c)
#define TIM_CCER(tim) R(tim, 0x20)
#define TIM_CCER_CC1E BIT(0)
#define TIM_CNT(tim) R(tim, 0x24)
#define TIM_PSC(tim) R(tim, 0x28)
#define TIM_ARR(tim) R(tim, 0x2c)
#define TIM_CCR1(tim) R(tim, 0x34)
#define TIM_BDTR(tim) R(tim, 0x44)
#define TIM_BDTR_MOE BIT(15)

/****************************************************************
 * DMA1: channel n at DMA_CHANNEL(n), flags of channel n four bits each
 ****************************************************************/

#define DMA1_BASE 0x40020000u
#define DMA1_ISR R(DMA1_BASE, 0x00)
#define DMA1_IFCR R(DMA1_BASE, 0x04)
#define DMA1_ISR_TCIF(n) BIT(4 * (n) - 3)
#define DMA1_ISR_HTIF(n) BIT(4 * (n) - 2)
#define DMA1_ISR_TEIF(n) BIT(4 * (n) - 1)
#define DMA_CHANNEL(n) (DMA1_BASE + 0x08u + 20u * ((n) - 1u))
#define DMA_CCR(channel) R(channel, 0x00)
#define DMA_CCR_EN BIT(0)
#define DMA_CCR_TCIE BIT(1)
#define DMA_CCR_HTIE BIT(2)
#define DMA_CCR_TEIE BIT(3)
#define DMA_CCR_DIR BIT(4)
#define DMA_CCR_CIRC BIT(5)
#define DMA_CCR_MINC BIT(7)
#define DMA_CCR_PSIZE(v) FIELD(v, 8, 2)
#define DMA_CCR_MSIZE(v) FIELD(v, 10, 2)
#define DMA_CCR_PL(v) FIELD(v, 12, 2)
#define DMA_CNDTR(channel) R(channel, 0x04)
#define DMA_CPAR(channel) R(channel, 0x08)
#define DMA_CMAR(channel) R(channel, 0x0c)

/****************************************************************
 * USART
 ****************************************************************/

#define USART2_BASE 0x40004400u
#define USART_CR1(usart) R(usart, 0x00)
#define USART_CR1_UE BIT(0)
#define USART_CR1_RE BIT(2)
#define USART_CR1_TE BIT(3)
#define USART_CR1_CMIE BIT(14)
#define USART_CR2(usart) R(usart, 0x04)
#define USART_CR2_ADD4(v) FIELD(v, 28, 4)
#define USART_CR2_ADD0(v) FIELD(v, 24, 4)
#define USART_CR3(usart) R(usart, 0x08)
#define USART_CR3_DMAR BIT(6)
#define USART_CR3_DMAT BIT(7)
#define USART_CR3_OVRDIS BIT(12)
#define USART_BRR(usart) R(usart, 0x0c)
#define USART_ISR(usart) R(usart, 0x1c)
#define USART_ISR_TC BIT(6)
#define USART_ISR_CMF BIT(17)
#define USART_ICR(usart) R(usart, 0x20)
#define USART_ICR_CMCF BIT(17)
#define USART_RDR(usart) R(usart, 0x24)
#define USART_TDR(usart) R(usart, 0x28)

/****************************************************************
 * HRTIM: timers A and B at HRTIM_TIMER(0), HRTIM_TIMER(1)
 ****************************************************************/

#define HRTIM_MASTER_BASE 0x40017400u
#define HRTIM_MASTER_MCR R(HRTIM_MASTER_BASE, 0x00)
#define HRTIM_MASTER_MCR_TACEN BIT(17)
#define HRTIM_MASTER_MCR_TBCEN BIT(18)
#define HRTIM_TIMA_BASE 0x40017480u
#define HRTIM_STRIDE 0x80u
#define HRTIM_TIMER(n) (HRTIM_TIMA_BASE + HRTIM_STRIDE * (n))
#define HRTIM_TIM_CR(tim) R(tim, 0x00)
#define HRTIM_TIM_CR_CK_PSC(v) FIELD(v, 0, 3)
#define HRTIM_TIM_CR_CONT BIT(3)
#define HRTIM_TIM_CR_TxREPU BIT(17)
#define HRTIM_TIM_CR_PREEN BIT(27)
#define HRTIM_TIM_CNT(tim) R(tim, 0x10)
#define HRTIM_TIM_PER(tim) R(tim, 0x14)
#define HRTIM_TIM_REP(tim) R(tim, 0x18)
#define HRTIM_TIM_CMP1(tim) R(tim, 0x1c)
#define HRTIM_TIM_CMP2(tim) R(tim, 0x24)
#define HRTIM_TIM_CMP4(tim) R(tim, 0x2c)
#define HRTIM_TIM_DT(tim) R(tim, 0x38)
#define HRTIM_TIM_DT_DTR(v) FIELD(v, 0, 9)
#define HRTIM_TIM_DT_DTPRSC(v) FIELD(v, 10, 3)
#define HRTIM_TIM_DT_DTRSLK BIT(14)
#define HRTIM_TIM_DT_DTRLK BIT(15)
#define HRTIM_TIM_DT_DTF(v) FIELD(v, 16, 9)
#define HRTIM_TIM_DT_DTFSLK BIT(30)
#define HRTIM_TIM_DT_DTFLK BIT(31)
#define HRTIM_TIM_SET1(tim) R(tim, 0x3c)
#define HRTIM_TIM_SET1_PER BIT(2)
#define HRTIM_TIM_SET1_CMP1 BIT(3)
#define HRTIM_TIM_RST1(tim) R(tim, 0x40)
#define HRTIM_TIM_RST1_PER BIT(2)
#define HRTIM_TIM_RST1_CMP1 BIT(3)
#define HRTIM_TIM_RST1_CMP2 BIT(4)
#define HRTIM_TIM_OUT(tim) R(tim, 0x64)
#define HRTIM_TIM_OUT_FAULT1(v) FIELD(v, 4, 2)
#define HRTIM_TIM_OUT_DTEN BIT(8)
#define HRTIM_TIM_OUT_FAULT2(v) FIELD(v, 20, 2)
#define HRTIM_TIM_FLT(tim) R(tim, 0x68)
#define HRTIM_TIM_FLT_FLT1EN BIT(0)
#define HRTIM_TIM_FLT_FLTLCK BIT(31)
#define HRTIM_COMMON_BASE 0x40017780u
#define HRTIM_CR1 R(HRTIM_COMMON_BASE, 0x00)
#define HRTIM_CR1_TAUDIS BIT(1)
#define HRTIM_CR1_TBUDIS BIT(2)
#define HRTIM_ISR R(HRTIM_COMMON_BASE, 0x08)
#define HRTIM_ISR_FLT1 BIT(0)
#define HRTIM_ISR_SYSFLT BIT(5)
#define HRTIM_ISR_DLLRDY BIT(16)
#define HRTIM_ICR R(HRTIM_COMMON_BASE, 0x0c)
#define HRTIM_ICR_FLT1C BIT(0)
#define HRTIM_ICR_SYSFLTC BIT(5)
#define HRTIM_IER R(HRTIM_COMMON_BASE, 0x10)
#define HRTIM_IER_FLT1IE BIT(0)
#define HRTIM_IER_SYSFLTIE BIT(5)
#define HRTIM_OENR R(HRTIM_COMMON_BASE, 0x14)
#define HRTIM_OENR_TA1OEN BIT(0)
#define HRTIM_OENR_TA2OEN BIT(1)
#define HRTIM_OENR_TB1OEN BIT(2)
#define HRTIM_OENR_TB2OEN BIT(3)
#define HRTIM_ODISR R(HRTIM_COMMON_BASE, 0x18)
#define HRTIM_ADC1R R(HRTIM_COMMON_BASE, 0x3c)
#define HRTIM_ADC1R_AD1TAC4 BIT(12)
#define HRTIM_DLLCR R(HRTIM_COMMON_BASE, 0x4c)
#define HRTIM_DLLCR_CAL BIT(0)
#define HRTIM_DLLCR_CALEN BIT(1)
#define HRTIM_DLLCR_CALRTE(v) FIELD(v, 2, 2)
#define HRTIM_FLTINR1 R(HRTIM_COMMON_BASE, 0x50)
#define HRTIM_FLTINR1_FLT1E BIT(0)
#define HRTIM_FLTINR1_FLT1P BIT(1)
#define HRTIM_FLTINR1_FLT1F(v) FIELD(v, 3, 4)
#define HRTIM_FLTINR1_FLT1LCK BIT(7)

/****************************************************************
 * ADC
 ****************************************************************/

#define ADC1_BASE 0x50000000u
#define ADC2_BASE 0x50000100u
#define ADC_ISR(adc) R(adc, 0x00)
#define ADC_ISR_ADRDY BIT(0)
#define ADC_ISR_EOC BIT(2)
#define ADC_ISR_OVR BIT(4)
#define ADC_ISR_JEOC BIT(5)
#define ADC_IER(adc) R(adc, 0x04)
#define ADC_IER_OVRIE BIT(4)
#define ADC_CR(adc) R(adc, 0x08)
#define ADC_CR_ADEN BIT(0)
#define ADC_CR_ADSTART BIT(2)
#define ADC_CR_JADSTART BIT(3)
#define ADC_CR_ADSTP BIT(4)
#define ADC_CR_ADVREGEN(v) FIELD(v, 28, 2)
#define ADC_CR_ADCAL BIT(31)
#define ADC_CFGR(adc) R(adc, 0x0c)
#define ADC_CFGR_DMAEN BIT(0)
#define ADC_CFGR_DMACFG BIT(1)
#define ADC_CFGR_EXTSEL(v) FIELD(v, 6, 4)
#define ADC_CFGR_EXTEN(v) FIELD(v, 10, 2)
#define ADC_SMPR1(adc) R(adc, 0x14)
#define ADC_SMPR2(adc) R(adc, 0x18)
#define ADC_SQR1(adc) R(adc, 0x30)
#define ADC_SQR1_SQ1(v) FIELD(v, 6, 5)
#define ADC_DR(adc) R(adc, 0x40)
#define ADC_JSQR(adc) R(adc, 0x4c)
#define ADC_JSQR_JSQ1(v) FIELD(v, 8, 5)
#define ADC_JDR1(adc) R(adc, 0x80)
#define ADC12_COMMON_BASE 0x50000300u
#define ADC12_CCR R(ADC12_COMMON_BASE, 0x08)
#define ADC12_CCR_CKMODE(v) FIELD(v, 16, 2)
#define ADC12_CCR_TSEN BIT(23)

/****************************************************************
 * SPI, I2C
 ****************************************************************/

#define SPI1_BASE 0x40013000u
#define SPI_CR1(spi) R(spi, 0x00)
#define SPI_CR1_CPHA BIT(0)
#define SPI_CR1_CPOL BIT(1)
#define SPI_CR1_MSTR BIT(2)
#define SPI_CR1_BR(v) FIELD(v, 3, 3)
#define SPI_CR1_SPE BIT(6)
#define SPI_CR1_SSI BIT(8)
#define SPI_CR1_SSM BIT(9)
#define SPI_CR2(spi) R(spi, 0x04)
#define SPI_CR2_DS(v) FIELD(v, 8, 4)
#define SPI_CR2_FRXTH BIT(12)
#define SPI_SR(spi) R(spi, 0x08)
#define SPI_SR_RXNE BIT(0)
#define SPI_SR_TXE BIT(1)
#define SPI_SR_BSY BIT(7)
#define SPI_DR8(spi) R8(spi, 0x0c)

#define I2C1_BASE 0x40005400u
#define I2C_CR1(i2c) R(i2c, 0x00)
#define I2C_CR1_PE BIT(0)
#define I2C_CR2(i2c) R(i2c, 0x04)
#define I2C_CR2_SADD1(v) FIELD(v, 1, 7)
#define I2C_CR2_RD_WRN BIT(10)
#define I2C_CR2_START BIT(13)
#define I2C_CR2_STOP BIT(14)
#define I2C_CR2_NBYTES(v) FIELD(v, 16, 8)
#define I2C_TIMINGR(i2c) R(i2c, 0x10)
#define I2C_TIMINGR_SCLL(v) FIELD(v, 0, 8)
#define I2C_TIMINGR_SCLH(v) FIELD(v, 8, 8)
#define I2C_TIMINGR_SDADEL(v) FIELD(v, 16, 4)
#define I2C_TIMINGR_SCLDEL(v) FIELD(v, 20, 4)
#define I2C_TIMINGR_PRESC(v) FIELD(v, 28, 4)
#define I2C_ISR(i2c) R(i2c, 0x18)
#define I2C_ISR_TXIS BIT(1)
#define I2C_ISR_RXNE BIT(2)
#define I2C_ISR_NACKF BIT(4)
#define I2C_ISR_STOPF BIT(5)
#define I2C_ISR_TC BIT(6)
#define I2C_ISR_BUSY BIT(15)
#define I2C_ICR(i2c) R(i2c, 0x1c)
#define I2C_ICR_NACKCF BIT(4)
#define I2C_ICR_STOPCF BIT(5)
#define I2C_RXDR(i2c) R(i2c, 0x24)
#define I2C_TXDR(i2c) R(i2c, 0x28)

/****************************************************************
 * Cortex-M4 (PM0214)
 ****************************************************************/

#define NVIC_BASE 0xe000e100u
#define NVIC_ISER(n) R(NVIC_BASE, 0x000 + 4 * (n))
#define NVIC_ISPR(n) R(NVIC_BASE, 0x100 + 4 * (n))
#define SCB_BASE 0xe000ed00u
#define SCB_VTOR R(SCB_BASE, 0x08)
#define SCB_AIRCR R(SCB_BASE, 0x0c)
#define SCB_AIRCR_SYSRESETREQ (FIELD(0x5fa, 16, 16) | BIT(2))

/* Positions in the vector table (RM0364). */
enum {
    IRQ_DMA1_CHANNEL1 = 11,
    IRQ_DMA1_CHANNEL7 = 17,
    IRQ_ADC1_2 = 18,
    IRQ_TIM2 = 28,
    IRQ_USART2 = 38,
    IRQ_HRTIM1_FLT = 73,
    IRQ_COUNT = 82,
};

#endif
