/* Registers of the STM32F405 and F407 that this board uses, no more. Their source is ST's reference manual RM0090: chapters on
 * RCC of the F405/407, flash interface, GPIO, DMA (the table of DMA1 requests), TIM2 to TIM5, USART, RNG; alternate functions of
 * pins are those of the data sheet. With CMSIS at hand include stm32f407xx.h instead: the members have the same names, but for
 * the streams, which CMSIS declares one by one.
 */
#ifndef STM32F4_REGISTERS_H
#define STM32F4_REGISTERS_H

#include <stdint.h>

struct stm32_rcc {
    volatile uint32_t CR, PLLCFGR, CFGR, CIR, AHB1RSTR, AHB2RSTR, AHB3RSTR, reserved0, APB1RSTR, APB2RSTR, reserved1[2];
    volatile uint32_t AHB1ENR, AHB2ENR, AHB3ENR, reserved2, APB1ENR, APB2ENR, reserved3[10], BDCR, CSR;
};

struct stm32_flash {
    volatile uint32_t ACR;
};

struct stm32_gpio {
    volatile uint32_t MODER, OTYPER, OSPEEDR, PUPDR, IDR, ODR, BSRR, LCKR, AFR[2];
};

struct stm32_timer {
    volatile uint32_t CR1, CR2, SMCR, DIER, SR, EGR, CCMR1, CCMR2, CCER, CNT, PSC, ARR, RCR, CCR[4];
};

struct stm32_usart {
    volatile uint32_t SR, DR, BRR, CR1, CR2, CR3;
};

struct stm32_dma {
    volatile uint32_t LISR, HISR, LIFCR, HIFCR;
    struct stm32_dma_stream {
        volatile uint32_t CR, NDTR, PAR, M0AR, M1AR, FCR;
    } streams[8];
};

struct stm32_rng {
    volatile uint32_t CR, SR, DR;
};

#ifdef STM32F4_FAKE /* tests on a computer put memory there */
extern struct stm32_timer fake_tim2;
extern struct stm32_dma fake_dma1;
extern struct stm32_rcc fake_rcc;
extern struct stm32_gpio fake_gpioa;
#define TIM2 (&fake_tim2)
#define DMA1 (&fake_dma1)
#define RCC (&fake_rcc)
#define GPIOA (&fake_gpioa)
#else
#define TIM2 ((struct stm32_timer *)0x40000000u)
#define USART3 ((struct stm32_usart *)0x40004800u)
#define GPIOA ((struct stm32_gpio *)0x40020000u)
#define GPIOD ((struct stm32_gpio *)0x40020C00u)
#define RCC ((struct stm32_rcc *)0x40023800u)
#define FLASH ((struct stm32_flash *)0x40023C00u)
#define DMA1 ((struct stm32_dma *)0x40026000u)
#define RNG ((struct stm32_rng *)0x50060800u)
#endif

#define SYSTEM_RESET_CONTROL (*(volatile uint32_t *)0xE000ED0Cu)
#define INTERRUPT_ENABLE ((volatile uint32_t *)0xE000E100u)

enum { USART3_INTERRUPT = 39 };

/* Bits, named after their registers. */
enum {
    RCC_CR_HSEON = 1 << 16,
    RCC_CR_HSERDY = 1 << 17,
    RCC_CR_PLLON = 1 << 24,
    RCC_CR_PLLRDY = 1 << 25,
    RCC_PLLCFGR_HSE = 1 << 22,
    RCC_CFGR_SW_PLL = 2,
    RCC_CFGR_SWS = 3 << 2,
    RCC_CFGR_SWS_PLL = 2 << 2,
    RCC_CFGR_APB1_BY_4 = 5 << 10,
    RCC_CFGR_APB2_BY_2 = 4 << 13,
    RCC_AHB1ENR_GPIOA = 1 << 0,
    RCC_AHB1ENR_GPIOD = 1 << 3,
    RCC_AHB1ENR_DMA1 = 1 << 21,
    RCC_AHB2ENR_RNG = 1 << 6,
    RCC_APB1ENR_TIM2 = 1 << 0,
    RCC_APB1ENR_USART3 = 1 << 18,
    RCC_CSR_RMVF = 1 << 24,
    RCC_CSR_BORRSTF = 1 << 25,
    RCC_CSR_PINRSTF = 1 << 26,
    RCC_CSR_PORRSTF = 1 << 27,
    RCC_CSR_SFTRSTF = 1 << 28,
    RCC_CSR_IWDGRSTF = 1 << 29,
    RCC_CSR_WWDGRSTF = 1 << 30,
    FLASH_ACR_5_WAITS_AND_CACHES = 0x705,
    TIM_CR1_CEN = 1 << 0,
    TIM_EGR_UG = 1 << 0,
    TIM_DIER_CC1DE = 1 << 9,
    TIM_SR_CC1OF = 1 << 9,
    DMA_CR_EN = 1 << 0,
    DMA_CR_TO_PERIPHERAL = 1 << 6,
    DMA_CR_CIRC = 1 << 8,
    DMA_CR_MINC = 1 << 10,
    DMA_CR_PSIZE_WORD = 2 << 11,
    DMA_CR_MSIZE_WORD = 2 << 13,
    DMA_CR_HIGHEST = 3 << 16,
    DMA_CR_CHANNEL_SHIFT = 25,
    DMA_LIFCR_STREAM_3 = 0x3D << 22,
    USART_SR_RXNE = 1 << 5,
    USART_SR_ORE = 1 << 3,
    USART_CR1_RE = 1 << 2,
    USART_CR1_TE = 1 << 3,
    USART_CR1_RXNEIE = 1 << 5,
    USART_CR1_UE = 1 << 13,
    USART_CR1_OVER8 = 1 << 15,
    USART_CR3_DMAT = 1 << 7,
    RNG_CR_RNGEN = 1 << 2,
    RNG_SR_DRDY = 1 << 0
};

#endif
