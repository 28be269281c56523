/* Inside of the board: room in the output queue, shared by answers and frames. */
#ifndef RESONATOR_OUTPUT_H
#define RESONATOR_OUTPUT_H

#include "resonator_board.h"
#include "resonator_messages.h"

/* Drops the oldest frames until so many payload bytes find room as a packet. */
bool resonator_make_room(struct resonator_board *board, uint32_t payload_bytes);

/* Counts the frames in the queue, and one that is cut off, as dropped, before it is emptied. */
void resonator_count_queued_as_dropped(struct resonator_board *board);

struct resonator_head resonator_head_of(const struct resonator_board *board, uint8_t type, uint32_t sequence);

#endif
