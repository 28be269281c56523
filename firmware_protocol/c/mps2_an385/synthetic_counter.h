/* Stands in for counter hardware: tones of quartz16 at four corners, counted exactly, and a touch now and then. */

#ifndef SYNTHETIC_COUNTER_H
#define SYNTHETIC_COUNTER_H

#include <stdint.h>

#include "resonator_board.h"

struct synthetic_tone {
    uint64_t millihertz;
    uint32_t period_ticks; /* of a stride, its whole ticks and the rest in 2^-32 */
    uint32_t period_fraction;
    uint64_t next_ticks; /* of the stride that is counted next */
    uint32_t next_fraction;
    uint32_t next_edge;
};

struct synthetic_counter {
    struct synthetic_tone tones[RESONATOR_CHANNELS];
    uint64_t ticks; /* where the next gate opens */
    bool touched;
    bool broken; /* the next record's stamps do not continue those before */
};

/* Opens a gate at `ticks`. */
void synthetic_start(struct synthetic_counter *counter, uint64_t ticks);

/* Closes the gate at `ticks`, where the next one opens, and fills in what was counted in it. */
void synthetic_gate(struct synthetic_counter *counter, uint64_t ticks, struct resonator_record records[]);

#endif
