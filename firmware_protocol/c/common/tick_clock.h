/* 64-bit ticks from a counter of fewer bits, and the ticks of a captured count.
 *
 * Two ways, for two kinds of hardware. A 32-bit timer is read at least once per wrap: `tick_clock_update`. A 16-bit
 * timer wraps too often for that: its update interrupt counts the wraps, and `tick_clock_extended` joins both.
 */
#ifndef TICK_CLOCK_H
#define TICK_CLOCK_H

#include <stdbool.h>
#include <stdint.h>

struct tick_clock {
    uint64_t ticks; /* at the latest reading */
    uint32_t mask;  /* of the counter's bits */
};

/* Begin with this count. The first wrap is taken as past, so that a capture just before has ticks above 0. */
static inline void tick_clock_begin(struct tick_clock *clock, uint32_t bits, uint32_t count)
{
    clock->mask = bits < 32 ? (1u << bits) - 1u : UINT32_MAX;
    clock->ticks = (uint64_t)clock->mask + 1u + (count & clock->mask);
}

/* Return the ticks of a reading that is newer than the last one by less than a wrap. */
static inline uint64_t tick_clock_update(struct tick_clock *clock, uint32_t count)
{
    clock->ticks += (count - (uint32_t)clock->ticks) & clock->mask;
    return clock->ticks;
}

/* Return the ticks of a count that was captured less than half a wrap before or after the latest reading. */
static inline uint64_t tick_clock_at(const struct tick_clock *clock, uint32_t count)
{
    uint32_t ahead = (count - (uint32_t)clock->ticks) & clock->mask;
    if (ahead <= clock->mask / 2u) {
        return clock->ticks + ahead;
    }
    return clock->ticks - ((uint64_t)clock->mask + 1u - ahead);
}

/* Return the 64-bit value of the count, where an interrupt counts the wraps and `pending` is its flag.
 *
 * The race: the counter wraps close to the reading, and the interrupt has not run yet. With that interrupt masked read,
 * in this order: count, flag, wraps. A small count with the flag set is of behind the wrap, a large one of before it.
 * The interrupt must run within half a wrap.
 *
 * Of a captured count this says nothing: the interrupt may have run between the capture and its reading. Read the count
 * as here, and place the capture by `tick_clock_at`.
 */
static inline uint64_t tick_clock_extended(uint64_t wraps, bool pending, uint32_t count, uint32_t bits)
{
    if (pending && count < 1u << (bits - 1u)) {
        wraps++;
    }
    return wraps << bits | count;
}

#endif
