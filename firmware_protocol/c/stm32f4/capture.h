/* Input capture: the four channels of TIM2, each with DMA to a ring of its own, to records of gates. */
#ifndef STM32F4_CAPTURE_H
#define STM32F4_CAPTURE_H

#include <stdint.h>

#include "resonator_board.h"

/* TIM2 runs at twice the APB1 clock of 42 MHz. */
enum { TICKS_HZ = 84000000 };

/* Each corner's signal is divided in front of the chip by EXTERNAL_DIVIDER (a 74HC or an FPGA), and by 8 in the timer's
   input prescaler: at 10 MHz 156 stamps in a gate of 1 ms. */
enum { EXTERNAL_DIVIDER = 8, STRIDE_EDGES = 8 * EXTERNAL_DIVIDER };

/* A ring holds 2048 stamps, 13 ms at 10 MHz. */
enum { CAPTURE_RING_BITS = 11 };

/* Begin to count and to capture; ticks start, and go on until the next reset. */
void capture_begin(void);

/* Return the ticks since the start. Call it more often than the timer wraps (51 s). */
uint64_t capture_ticks(void);

/* Return the ticks of a count that was read from TIM2 less than 25 s ago. */
uint64_t capture_ticks_at(uint32_t count);

/* Begin a run: its first gate starts now. */
void capture_run(uint64_t now_ticks, uint64_t gate_ticks);

/* Read the stamps, and close the open gate if it is over. Call it at least each 5 ms, or stamps are lost.
   Return 0 when the gate is open, 1 with `records` and the gate's end, and -1 for a gate that was missed. */
int capture_gate(struct resonator_record records[RESONATOR_CHANNELS], uint64_t *end_ticks);

#endif
