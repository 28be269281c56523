/* TIM2 counts the reference in 32 bits. PA0 to PA3 are its channels 1 to 4; a capture is a DMA request. No interrupt. */

#include "capture.h"

#include <stdbool.h>

#include "common/capture_ring.h"
#include "registers.h"

enum { RING_WORDS = 1 << CAPTURE_RING_BITS };

/* Stream and channel of DMA1 for each channel of TIM2. */
static const struct {
    uint8_t stream, request;
} dma_of[RESONATOR_CHANNELS] = {{5, 3}, {6, 3}, {1, 3}, {7, 3}};

/* So long a capture may be on its way to memory: 10 us, for DMA serves one request after the other within 1 us. */
enum { LAG_TICKS = TICKS_HZ / 100000 };

/* Beyond half a ring nobody could be sure how often DMA has gone round: 5 ms, at up to 200 stamps per ms. */
enum { POLL_TICKS_MAX = TICKS_HZ / 200 };

/* A bit for each channel. */
static const uint32_t all_channels = (1u << RESONATOR_CHANNELS) - 1u;

static volatile uint32_t rings[RESONATOR_CHANNELS][RING_WORDS];
static struct capture_ring captures[RESONATOR_CHANNELS];
static struct tick_clock positions[RESONATOR_CHANNELS]; /* words that DMA has written: a counter of 11 bits */
static struct tick_clock clock;
static struct gate_sorter sorter;
static uint64_t polled_ticks;
static uint32_t gates_missed; /* skipped, and not reported to the caller yet */

static void begin_channel(uint32_t channel)
{
    struct stm32_dma_stream *stream = &DMA1->streams[dma_of[channel].stream];
    stream->CR = 0;
    while (stream->CR & DMA_CR_EN)
        ;
    stream->PAR = (uint32_t)(uintptr_t)&TIM2->CCR[channel];
    stream->M0AR = (uint32_t)(uintptr_t)rings[channel];
    stream->NDTR = RING_WORDS;
    stream->FCR = 0; /* direct: a word is in memory as soon as it is counted */
    stream->CR = (uint32_t)dma_of[channel].request << DMA_CR_CHANNEL_SHIFT | DMA_CR_HIGHEST | DMA_CR_MSIZE_WORD |
                 DMA_CR_PSIZE_WORD | DMA_CR_MINC | DMA_CR_CIRC;
    stream->CR |= DMA_CR_EN;
    capture_ring_begin(&captures[channel], rings[channel], CAPTURE_RING_BITS);
    tick_clock_begin(&positions[channel], CAPTURE_RING_BITS, 0);
    captures[channel].read = positions[channel].ticks;
}

void capture_begin(void)
{
    RCC->AHB1ENR |= RCC_AHB1ENR_GPIOA | RCC_AHB1ENR_DMA1;
    RCC->APB1ENR |= RCC_APB1ENR_TIM2;
    GPIOA->AFR[0] = (GPIOA->AFR[0] & ~0xFFFFu) | 0x1111u; /* PA0 to PA3: AF1, TIM2 */
    GPIOA->MODER = (GPIOA->MODER & ~0xFFu) | 0xAAu;       /* alternate function */

    TIM2->CR1 = 0;
    TIM2->PSC = 0;
    TIM2->ARR = UINT32_MAX;
    TIM2->EGR = TIM_EGR_UG;
    TIM2->CCMR1 = 0x0D0Du; /* both channels: input of their own pin, prescaler 8, no filter */
    TIM2->CCMR2 = 0x0D0Du;
    TIM2->CCER = 0x1111u; /* rising edges, enabled */
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        begin_channel(channel);
    TIM2->SR = 0;
    TIM2->DIER = all_channels * TIM_DIER_CC1DE;
    tick_clock_begin(&clock, 32, TIM2->CNT);
    TIM2->CR1 = TIM_CR1_CEN;
    capture_run(capture_ticks(), TICKS_HZ / 1000);
}

uint64_t capture_ticks(void)
{
    return tick_clock_update(&clock, TIM2->CNT);
}

uint64_t capture_ticks_at(uint32_t count)
{
    return tick_clock_at(&clock, count);
}

static uint64_t written(uint32_t channel)
{
    return tick_clock_update(&positions[channel], RING_WORDS - DMA1->streams[dma_of[channel].stream].NDTR);
}

void capture_run(uint64_t now_ticks, uint64_t gate_ticks)
{
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        capture_ring_discard(&captures[channel], written(channel));
    gate_sorter_begin(&sorter, now_ticks, gate_ticks, STRIDE_EDGES);
    polled_ticks = now_ticks;
    gates_missed = 0;
}

static void lose(uint32_t channels)
{
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        if (channels & 1u << channel)
            gate_sorter_lost(&sorter, channel);
}

/* First the time, then how far DMA is, then the words: each is older than what follows it. */
static uint64_t poll(void)
{
    uint64_t now_ticks = capture_ticks();
    uint64_t words[RESONATOR_CHANNELS];
    bool late = now_ticks - polled_ticks > POLL_TICKS_MAX;
    polled_ticks = now_ticks;
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        words[channel] = written(channel);
    if (late) { /* a debugger had it stopped, or flash was erased */
        for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
            capture_ring_discard(&captures[channel], words[channel]);
        for (; gate_sorter_due(&sorter, now_ticks, 0); gates_missed++)
            gate_sorter_skip(&sorter);
        lose(all_channels);
    }
    uint32_t overwritten = TIM2->SR & all_channels * TIM_SR_CC1OF; /* in the timer, before DMA had read it */
    TIM2->SR = ~overwritten; /* a bit is cleared by 0 and kept by 1 */
    lose(overwritten / TIM_SR_CC1OF);
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        capture_ring_sort(&captures[channel], words[channel], &clock, &sorter, channel);
    return now_ticks;
}

int capture_gate(struct resonator_record records[RESONATOR_CHANNELS], uint64_t *end_ticks)
{
    uint64_t now_ticks = poll();
    if (gates_missed > 0) {
        gates_missed--;
        return -1;
    }
    if (!gate_sorter_due(&sorter, now_ticks, LAG_TICKS))
        return 0;
    *end_ticks = gate_sorter_close(&sorter, records);
    return 1;
}
