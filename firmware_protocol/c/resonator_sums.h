/* Exact sums over the time stamps of one channel in one gate, stamp by stamp: what a single-tone record carries.
 *
 * With t_k the stamps and x_k = t_k - t_0: s1 += x_k, s2 += k x_k, q2 += (t_k - 2 t_(k-1) + t_(k-2))^2. Stamps are the
 * counter's lower 32 bits; a gate is shorter than 2^32 ticks. Some 30 instructions a stamp, no division.
 */
#ifndef RESONATOR_SUMS_H
#define RESONATOR_SUMS_H

#include <stdbool.h>
#include <stdint.h>

#include "resonator_board.h"

#define RESONATOR_MAX_STAMPS 65535

struct resonator_sums {
    uint32_t stamps;
    uint32_t first_edge;
    uint32_t first_ticks;
    uint32_t last_ticks;
    uint32_t last_interval_ticks;
    uint64_t s1_ticks;
    uint64_t s2_ticks;
    uint64_t q2_ticks2;
};

/* A gate opens. */
static inline void resonator_sums_begin(struct resonator_sums *sums)
{
    sums->stamps = 0;
    sums->first_edge = 0;
    sums->first_ticks = 0;
    sums->last_ticks = 0;
    sums->last_interval_ticks = 0;
    sums->s1_ticks = 0;
    sums->s2_ticks = 0;
    sums->q2_ticks2 = 0;
}

/* Adds the stamp of an edge. False: the record is full (flag it RESONATOR_OVERFLOW), the stamp is left out. */
static inline bool resonator_sums_add(struct resonator_sums *sums, uint32_t edge, uint32_t ticks)
{
    if (sums->stamps == RESONATOR_MAX_STAMPS) {
        return false;
    }
    if (sums->stamps == 0) {
        sums->first_edge = edge;
        sums->first_ticks = ticks;
    } else {
        uint32_t offset_ticks = ticks - sums->first_ticks;
        uint32_t interval_ticks = ticks - sums->last_ticks;
        sums->s1_ticks += offset_ticks;
        sums->s2_ticks += (uint64_t)sums->stamps * offset_ticks;
        if (sums->stamps > 1) {
            uint32_t bend_ticks = interval_ticks > sums->last_interval_ticks
                                      ? interval_ticks - sums->last_interval_ticks
                                      : sums->last_interval_ticks - interval_ticks;
            uint64_t square = (uint64_t)bend_ticks * bend_ticks;
            /* Only nonsense comes near the limit; it stays there and does not wrap to something plausible. */
            sums->q2_ticks2 = square > UINT64_MAX - sums->q2_ticks2 ? UINT64_MAX : sums->q2_ticks2 + square;
        }
        sums->last_interval_ticks = interval_ticks;
    }
    sums->last_ticks = ticks;
    sums->stamps++;
    return true;
}

/* Fills all of a record but attenuation_db256 and flags, when the gate closes; without a stamp all of it is 0. */
static inline void resonator_sums_record(const struct resonator_sums *sums, uint16_t stride_edges,
                                         struct resonator_record *record)
{
    record->first_edge = sums->first_edge;
    record->first_ticks = sums->first_ticks;
    record->stamps = (uint16_t)sums->stamps;
    record->stride_edges = sums->stamps == 0 ? 0 : stride_edges;
    record->span_ticks = sums->last_ticks - sums->first_ticks;
    record->s1_ticks = sums->s1_ticks;
    record->s2_ticks = sums->s2_ticks;
    record->q2_ticks2 = sums->q2_ticks2;
}

#endif
