/* Edge capture: four state machines of PIO 0, each with DMA to a ring of its own, to records of gates. */
#ifndef RP2040_CAPTURE_H
#define RP2040_CAPTURE_H

#include <stdint.h>

#include "resonator_board.h"

/* A tick is two cycles of the system clock of 125 MHz. */
enum { TICKS_HZ = 62500000 };

/* The four signals are on neighbouring pins. Every 200th edge is a stamp: at 10 MHz 50 in a gate of 1 ms. */
enum { FIRST_PIN = 2, STRIDE_EDGES = 200 };

/* Begin to count and to capture. */
void capture_begin(void);

/* Return the ticks since the start. */
uint64_t capture_ticks(void);

/* Begin a run: its first gate starts now. */
void capture_run(uint64_t now_ticks, uint64_t gate_ticks);

/* Read the stamps, and close the open gate if it is over. Call it at least each 10 ms, or stamps are lost.
   Return 0 when the gate is open, 1 with `records` and the gate's end, and -1 for a gate that was missed. */
int capture_gate(struct resonator_record records[RESONATOR_CHANNELS], uint64_t *end_ticks);

#endif
