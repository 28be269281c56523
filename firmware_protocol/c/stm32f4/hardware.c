/* Clocks, USART3 with DMA towards the host, random number, LED. Register names are those of RM0090. */

#include "hardware.h"

#include "capture.h"
#include "common/receive_ring.h"
#include "registers.h"
#include "resonator_board.h"

enum { CRYSTAL_TRIES = 1000000, RANDOM_TRIES = 100000 }; /* of the order of 0.1 s and 10 ms at 16 MHz */
enum { SEND_STREAM = 3, SEND_REQUEST = 4 };              /* of DMA1, for USART3 */

static struct receive_ring received;

static bool becomes(const volatile uint32_t *flags, uint32_t mask, uint32_t value)
{
    for (uint32_t tries = 0; tries < CRYSTAL_TRIES; tries++)
        if ((*flags & mask) == value)
            return true;
    return false;
}

bool hardware_begin(void)
{
    RCC->AHB1ENR |= RCC_AHB1ENR_GPIOD | RCC_AHB1ENR_DMA1;
    RCC->AHB2ENR |= RCC_AHB2ENR_RNG;
    RCC->APB1ENR |= RCC_APB1ENR_USART3;
    GPIOD->MODER = (GPIOD->MODER & ~(3u << 24)) | 1u << 24; /* PD12, the LED: output */

    RCC->CR |= RCC_CR_HSEON;
    if (!becomes(&RCC->CR, RCC_CR_HSERDY, RCC_CR_HSERDY))
        return false;
    /* 8 MHz / 8 * 336: by 2 is 168 MHz for the core, by 7 is 48 MHz for the random numbers. */
    RCC->PLLCFGR = 8u | 336u << 6 | 0u << 16 | RCC_PLLCFGR_HSE | 7u << 24;
    RCC->CR |= RCC_CR_PLLON;
    if (!becomes(&RCC->CR, RCC_CR_PLLRDY, RCC_CR_PLLRDY))
        return false;
    FLASH->ACR = FLASH_ACR_5_WAITS_AND_CACHES;
    RCC->CFGR = RCC_CFGR_APB1_BY_4 | RCC_CFGR_APB2_BY_2 | RCC_CFGR_SW_PLL;
    return becomes(&RCC->CFGR, RCC_CFGR_SWS, RCC_CFGR_SWS_PLL);
}

uint32_t hardware_boot_id(void)
{
    RNG->CR = RNG_CR_RNGEN;
    for (uint32_t tries = 0; tries < RANDOM_TRIES; tries++) {
        if (RNG->SR & RNG_SR_DRDY) {
            uint32_t drawn = RNG->DR;
            if (drawn != 0)
                return drawn;
        }
    }
    return TIM2->CNT | 1u; /* without the clock of 48 MHz: better than a constant, and the board reports a fault */
}

uint8_t hardware_reset_cause(void)
{
    /* Power on sets the flags of the brown-out and of the pin as well: the rarest cause is looked for first. */
    static const struct {
        uint32_t flag;
        uint8_t cause;
    } causes[] = {
        {RCC_CSR_IWDGRSTF, RESONATOR_RESET_WATCHDOG}, {RCC_CSR_WWDGRSTF, RESONATOR_RESET_WATCHDOG},
        {RCC_CSR_SFTRSTF, RESONATOR_RESET_SOFTWARE},  {RCC_CSR_PORRSTF, RESONATOR_RESET_POWER_ON},
        {RCC_CSR_BORRSTF, RESONATOR_RESET_BROWN_OUT}, {RCC_CSR_PINRSTF, RESONATOR_RESET_PIN},
    };
    uint32_t flags = RCC->CSR;
    RCC->CSR = flags | RCC_CSR_RMVF;
    for (size_t i = 0; i < sizeof causes / sizeof causes[0]; i++)
        if (flags & causes[i].flag)
            return causes[i].cause;
    return RESONATOR_RESET_UNKNOWN;
}

void hardware_restart(void)
{
    __asm__ volatile("dsb" ::: "memory");
    SYSTEM_RESET_CONTROL = 0x05FA0004u;
    for (;;)
        ;
}

void serial_begin(void)
{
    GPIOD->OSPEEDR |= 2u << 16; /* PD8: fast edges */
    GPIOD->AFR[1] = (GPIOD->AFR[1] & ~0xFFu) | 0x77u; /* PD8, PD9: AF7, USART3 */
    GPIOD->MODER = (GPIOD->MODER & ~(0xFu << 16)) | 0xAu << 16;
    USART3->BRR = 1u << 4 | 6u; /* 42 MHz / (8 * (1 + 6/8)) = 3 Mbaud, exactly */
    USART3->CR3 = USART_CR3_DMAT;
    USART3->CR1 = USART_CR1_OVER8 | USART_CR1_UE | USART_CR1_TE | USART_CR1_RE | USART_CR1_RXNEIE;
    INTERRUPT_ENABLE[USART3_INTERRUPT / 32] = 1u << USART3_INTERRUPT % 32;
}

/* A host sends some kilobytes a second: each byte has its own time, which PONG carries. */
void serial_receive_handler(void)
{
    while (USART3->SR & (USART_SR_RXNE | USART_SR_ORE)) /* reading both registers clears both flags */
        (void)receive_ring_write(&received, (uint8_t)USART3->DR, TIM2->CNT);
}

size_t serial_read(uint8_t *bytes, size_t room, uint64_t *ticks)
{
    uint32_t count = 0;
    size_t size = receive_ring_read(&received, bytes, room, &count);
    *ticks = capture_ticks();
    if (size > 0)
        *ticks = capture_ticks_at(count);
    return size;
}

void serial_send(const uint8_t *bytes, uint16_t size)
{
    struct stm32_dma_stream *stream = &DMA1->streams[SEND_STREAM];
    DMA1->LIFCR = DMA_LIFCR_STREAM_3;
    stream->PAR = (uint32_t)(uintptr_t)&USART3->DR;
    stream->M0AR = (uint32_t)(uintptr_t)bytes;
    stream->NDTR = size;
    stream->FCR = 0;
    stream->CR = (uint32_t)SEND_REQUEST << DMA_CR_CHANNEL_SHIFT | DMA_CR_MINC | DMA_CR_TO_PERIPHERAL;
    __asm__ volatile("dsb" ::: "memory"); /* the bytes are in memory before DMA reads them */
    stream->CR |= DMA_CR_EN;
}

bool serial_idle(void)
{
    return (DMA1->streams[SEND_STREAM].CR & DMA_CR_EN) == 0; /* hardware clears it behind the last byte */
}

void led_set(bool on)
{
    GPIOD->BSRR = on ? 1u << 12 : 1u << 28;
}
