/* A ring of captured counts that DMA fills without end, and its stamps on their way to the gate sorter.
 *
 * A timer captures the count itself. A PIO program counts down and misses a fixed number of ticks at each stamp that it
 * writes: `down` and `missed_ticks` undo both, by the number of the word since the capture began.
 */
#ifndef CAPTURE_RING_H
#define CAPTURE_RING_H

#include <stdbool.h>
#include <stdint.h>

#include "common/gate_sorter.h"
#include "common/tick_clock.h"

enum { CAPTURE_RING_GUARD = 4 }; /* words that may be overwritten while they are read */

struct capture_ring {
    const volatile uint32_t *words;
    uint32_t bits; /* the ring has 2^bits words */
    bool down;
    uint32_t missed_ticks; /* at each word, of a counter that does not count meanwhile */
    uint64_t read;         /* words that were read since the capture began */
};

void capture_ring_begin(struct capture_ring *ring, const volatile uint32_t *words, uint32_t bits);

/* Add stamps to the open gate of `channel`, up to the first that lies beyond it.
 *
 * `written` is the number of words since the capture began. `clock` was updated before `written` was read, less than a
 * quarter of a wrap ago, and no word waits for longer than that. Words that were overwritten count as lost.
 */
void capture_ring_sort(struct capture_ring *ring, uint64_t written, const struct tick_clock *clock,
                       struct gate_sorter *sorter, uint32_t channel);

/* Discard all words written so far, as at the begin of a run. */
void capture_ring_discard(struct capture_ring *ring, uint64_t written);

#endif
