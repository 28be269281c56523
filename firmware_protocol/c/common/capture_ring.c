#include "common/capture_ring.h"

void capture_ring_begin(struct capture_ring *ring, const volatile uint32_t *words, uint32_t bits)
{
    ring->words = words;
    ring->bits = bits;
    ring->down = false;
    ring->missed_ticks = 0;
    ring->read = 0;
}

static uint32_t count_of(const struct capture_ring *ring, uint32_t word)
{
    uint32_t count = ring->down ? 0u - word : word;
    return count + (uint32_t)ring->read * ring->missed_ticks;
}

void capture_ring_sort(struct capture_ring *ring, uint64_t written, const struct tick_clock *clock,
                       struct gate_sorter *sorter, uint32_t channel)
{
    uint32_t size = 1u << ring->bits;
    if (written - ring->read > size - CAPTURE_RING_GUARD) {
        ring->read = written;
        gate_sorter_lost(sorter, channel);
    }
    while (ring->read != written) {
        uint32_t word = ring->words[(uint32_t)ring->read & (size - 1u)];
        if (!gate_sorter_add(sorter, channel, tick_clock_at(clock, count_of(ring, word)))) {
            return;
        }
        ring->read++;
    }
}

void capture_ring_discard(struct capture_ring *ring, uint64_t written)
{
    ring->read = written;
}
