/* Stamps of four channels into gates: the records of single-tone frames.
 *
 * A gate is the half-open span of ticks [start, start + gate_ticks) and has no edge of its own; a stamp belongs to the
 * gate in which it lies, whenever it is read. All stamps of one channel are added in their order.
 */
#ifndef GATE_SORTER_H
#define GATE_SORTER_H

#include <stdbool.h>
#include <stdint.h>

#include "resonator_board.h"
#include "resonator_sums.h"

struct gate_channel {
    struct resonator_sums sums;
    uint32_t edge;  /* index of the newest stamped edge */
    uint16_t flags; /* of the open gate's record, besides those that follow from its sums */
    bool broken;    /* the next record does not continue the last one */
    bool closed;    /* no further stamp is added to this record: one is missing */
};

struct gate_sorter {
    uint64_t start_ticks; /* of the open gate */
    uint64_t gate_ticks;
    uint16_t stride_edges;
    bool first; /* no gate has been closed: older stamps are of the time before the run */
    struct gate_channel channels[RESONATOR_CHANNELS];
};

/* Begin a run whose first gate starts at `start_ticks`; edges between stamps: `stride_edges`. */
void gate_sorter_begin(struct gate_sorter *sorter, uint64_t start_ticks, uint64_t gate_ticks, uint16_t stride_edges);

/* Add the next stamp of a channel. False: it lies beyond the open gate; keep it, and add it again behind the close. */
bool gate_sorter_add(struct gate_sorter *sorter, uint32_t channel, uint64_t ticks);

/* Note that stamps of a channel are missing between the last one added and the next. */
void gate_sorter_lost(struct gate_sorter *sorter, uint32_t channel);

/* Whether the open gate ended at least `lag_ticks` ago: so long a stamp may be on its way. Read the ticks first, then
   the stamps, then close. */
bool gate_sorter_due(const struct gate_sorter *sorter, uint64_t now_ticks, uint64_t lag_ticks);

/* Fill the records of the open gate, attenuation 0, and open the next. Return the ticks at which the gate ended. */
uint64_t gate_sorter_close(struct gate_sorter *sorter, struct resonator_record records[RESONATOR_CHANNELS]);

/* Skip the open gate, whose stamps were missed, and open the next. */
void gate_sorter_skip(struct gate_sorter *sorter);

#endif
