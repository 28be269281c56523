/* Ring of received bytes with the timer's count at which each came: one interrupt writes, the main loop reads.
 *
 * The two indices are volatile, the slots are not: between a slot and its index stands a barrier, so that the compiler
 * keeps their order. A single core needs no more; with two cores define RECEIVE_RING_BARRIER as a memory barrier.
 */
#ifndef RECEIVE_RING_H
#define RECEIVE_RING_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifndef RECEIVE_RING_BARRIER
#define RECEIVE_RING_BARRIER() __asm__ volatile("" ::: "memory")
#endif

enum { RECEIVE_RING_SLOTS = 256 }; /* a power of two; more than a host may send before it is answered */

struct receive_ring {
    volatile uint32_t written; /* changed by the interrupt */
    volatile uint32_t read;    /* changed by the main loop */
    struct {
        uint32_t counts;
        uint8_t byte;
    } slots[RECEIVE_RING_SLOTS];
};

/* Store a byte, from the interrupt. False: the ring is full, the byte is lost; the protocol finds that out. */
static inline bool receive_ring_write(struct receive_ring *ring, uint8_t byte, uint32_t counts)
{
    uint32_t slot = ring->written;
    if (slot - ring->read == RECEIVE_RING_SLOTS)
        return false;
    ring->slots[slot % RECEIVE_RING_SLOTS].byte = byte;
    ring->slots[slot % RECEIVE_RING_SLOTS].counts = counts;
    RECEIVE_RING_BARRIER(); /* the slot is filled before it is given */
    ring->written = slot + 1;
    return true;
}

/* Move up to `room` bytes to `bytes`, from the main loop; `counts` becomes that of the last. Returns how many. */
static inline size_t receive_ring_read(struct receive_ring *ring, uint8_t *bytes, size_t room, uint32_t *counts)
{
    size_t count = 0;
    uint32_t slot = ring->read;
    uint32_t written = ring->written;
    RECEIVE_RING_BARRIER(); /* no slot is read before its index says that it is filled */
    while (count < room && slot != written) {
        bytes[count++] = ring->slots[slot % RECEIVE_RING_SLOTS].byte;
        *counts = ring->slots[slot % RECEIVE_RING_SLOTS].counts;
        slot++;
    }
    RECEIVE_RING_BARRIER(); /* the slots are read before they are given back */
    ring->read = slot;
    return count;
}

static inline bool receive_ring_empty(const struct receive_ring *ring)
{
    return ring->read == ring->written;
}

#endif
