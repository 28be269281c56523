#include "resonator_output.h"

#include <stddef.h>

#include "resonator_payloads.h"

bool resonator_make_room(struct resonator_board *board, uint32_t payload_bytes)
{
    while (!resonator_queue_fits(&board->queue, payload_bytes + RESONATOR_OVERHEAD_BYTES)) {
        uint16_t oldest = resonator_queue_oldest_frame(&board->queue);
        if (oldest == RESONATOR_NO_CHUNK) {
            return false;
        }
        if (oldest == board->open_frame) {
            board->open_frame = RESONATOR_NO_CHUNK;
        }
        resonator_queue_drop_oldest_frame(&board->queue);
        board->run_dropped++;
        board->output_counts.frames_dropped++;
    }
    return true;
}

void resonator_count_queued_as_dropped(struct resonator_board *board)
{
    uint32_t cut = 0;
    for (uint16_t at = board->queue.first_packet; at != RESONATOR_NO_CHUNK; at = board->queue.chunks[at].next_packet) {
        uint8_t kind = board->queue.chunks[at].kind;
        if (kind == RESONATOR_KIND_FRAME || (kind == RESONATOR_KIND_FRAME_MORE && cut == 0)) {
            cut++;
        }
    }
    if (cut == 0 && board->open_frame != RESONATOR_NO_CHUNK) {
        cut = 1; /* its first parts have gone out, the others are not made yet */
    }
    board->run_dropped += cut;
    board->output_counts.frames_dropped += cut;
}

struct resonator_head resonator_head_of(const struct resonator_board *board, uint8_t type, uint32_t sequence)
{
    struct resonator_head head;
    head.type = type;
    head.sequence = sequence;
    head.board_ticks = board->ticks;
    head.boot_id = board->boot_id;
    return head;
}

bool resonator_frame(struct resonator_board *board, uint64_t ticks,
                     const struct resonator_record records[RESONATOR_CHANNELS])
{
    board->ticks = ticks;
    if (board->state != RESONATOR_RUNNING) {
        return false;
    }
    struct resonator_head head = resonator_head_of(board, RESONATOR_FRAME, board->frame_sequence++);
    if (!board->asked || !resonator_make_room(board, RESONATOR_CHANNELS * RESONATOR_RECORD_BYTES)) {
        board->run_dropped++;
        board->output_counts.frames_dropped++;
        return false;
    }
    uint16_t frame = resonator_queue_packet(&board->queue, RESONATOR_KIND_FRAME, &head, resonator_put_records, records);
    board->queue.chunks[frame].skipped_before = board->run_skipped;
    return true;
}

static bool queue_part(struct resonator_board *board, const struct resonator_block *block,
                       const struct resonator_part *part)
{
    struct resonator_head head = resonator_head_of(board, RESONATOR_FRAME_PART, board->frame_sequence);
    uint32_t payload_bytes = resonator_payload_bytes(resonator_put_part, part);
    if (block->part == 0) {
        board->open_frame = RESONATOR_NO_CHUNK;
        if (!board->asked || !resonator_make_room(board, payload_bytes)) {
            board->run_dropped++;
            board->output_counts.frames_dropped++;
            return false;
        }
        board->open_frame =
            resonator_queue_packet(&board->queue, RESONATOR_KIND_FRAME, &head, resonator_put_part, part);
        board->queue.chunks[board->open_frame].skipped_before = board->run_skipped;
        return true;
    }
    if (board->open_frame == RESONATOR_NO_CHUNK) {
        return false; /* dropped, and counted then */
    }
    if (!resonator_make_room(board, payload_bytes)) {
        if (board->open_frame != RESONATOR_NO_CHUNK) {
            board->output_counts.parts_dropped++;
        }
        return false;
    }
    if (board->open_frame == RESONATOR_NO_CHUNK) {
        return false; /* its own first parts made the room */
    }
    (void)resonator_queue_packet(&board->queue, RESONATOR_KIND_FRAME_MORE, &head, resonator_put_part, part);
    return true;
}

bool resonator_frame_part(struct resonator_board *board, uint64_t ticks, const struct resonator_block *block,
                          const uint8_t *tones)
{
    struct resonator_part part;
    part.block = block;
    part.tones = tones;
    board->ticks = ticks;
    if (board->state != RESONATOR_RUNNING) {
        return false;
    }
    bool queued = queue_part(board, block, &part);
    if (block->part + 1 == block->parts) {
        board->open_frame = RESONATOR_NO_CHUNK;
        board->frame_sequence++;
    }
    return queued;
}

void resonator_frame_skipped(struct resonator_board *board)
{
    if (board->state == RESONATOR_RUNNING) {
        board->frame_sequence++;
        board->run_skipped++;
        board->output_counts.frames_dropped++;
    }
}

void resonator_status(struct resonator_board *board)
{
    board->status_due = board->asked;
}

void resonator_temperature(struct resonator_board *board, uint32_t millikelvin)
{
    board->temperature_known = true;
    board->temperature_millikelvin = millikelvin;
}

bool resonator_log(struct resonator_board *board, uint64_t ticks, enum resonator_log_level level, const char *text)
{
    struct resonator_log_line line;
    line.level = level;
    line.text = text;
    board->ticks = ticks;
    uint32_t size_bytes = resonator_payload_bytes(resonator_put_log, &line) + RESONATOR_OVERHEAD_BYTES;
    if (!board->asked || !resonator_queue_fits(&board->queue, size_bytes)) {
        board->output_counts.logs_dropped++;
        return false;
    }
    struct resonator_head head = resonator_head_of(board, RESONATOR_LOG, board->notice_sequence++);
    (void)resonator_queue_packet(&board->queue, RESONATOR_KIND_ANSWER, &head, resonator_put_log, &line);
    return true;
}

void resonator_fault(struct resonator_board *board, uint64_t ticks, const char *text)
{
    board->fault = text;
    board->ticks = ticks;
    if (text == NULL || board->state != RESONATOR_RUNNING) {
        return;
    }
    board->state = RESONATOR_CONFIGURED;
    board->open_frame = RESONATOR_NO_CHUNK;
    struct resonator_log_line line = {RESONATOR_LOG_ERROR, text};
    if (board->asked) {
        (void)resonator_make_room(board, resonator_payload_bytes(resonator_put_log, &line));
    }
    (void)resonator_log(board, ticks, line.level, text);
}

/* Of this run, numbered before the next frame that goes out. */
static uint32_t dropped_before_next_frame(const struct resonator_board *board)
{
    uint16_t next = resonator_queue_oldest_frame(&board->queue);
    uint32_t skipped =
        next == RESONATOR_NO_CHUNK ? board->run_skipped : board->queue.chunks[next].skipped_before;
    return board->run_dropped + skipped;
}

static void make_status(struct resonator_board *board)
{
    struct resonator_status_values status;
    status.frames_dropped = dropped_before_next_frame(board);
    status.temperature_known = board->temperature_known;
    status.temperature_millikelvin = board->temperature_millikelvin;
    status.bytes_discarded = board->decoder.counts.discarded;
    struct resonator_head head = resonator_head_of(board, RESONATOR_STATUS, board->notice_sequence++);
    board->status_bytes =
        (uint8_t)resonator_write_packet(board->status, sizeof board->status, &head, resonator_put_status, &status);
    board->status_read_bytes = 0;
    board->status_due = false;
    board->run_reported = status.frames_dropped;
}

uint16_t resonator_output(struct resonator_board *board, const uint8_t **bytes)
{
    uint16_t first = board->queue.first_packet;
    const struct resonator_chunk *packet = first == RESONATOR_NO_CHUNK ? NULL : &board->queue.chunks[first];
    if (board->status_bytes == 0 && (packet == NULL || packet->begun == 0)) {
        bool frame_next = packet != NULL && packet->kind == RESONATOR_KIND_FRAME;
        if (board->status_due || (frame_next && dropped_before_next_frame(board) != board->run_reported)) {
            make_status(board);
        }
    }
    if (board->status_bytes != 0) {
        *bytes = board->status + board->status_read_bytes;
        return (uint16_t)(board->status_bytes - board->status_read_bytes);
    }
    return resonator_queue_peek(&board->queue, bytes);
}

void resonator_consumed(struct resonator_board *board, uint16_t size)
{
    if (board->status_bytes == 0) {
        resonator_queue_consume(&board->queue, size);
        return;
    }
    board->status_read_bytes = (uint8_t)(board->status_read_bytes + size);
    if (board->status_read_bytes == board->status_bytes) {
        board->status_bytes = 0;
    }
}

uint32_t resonator_queue_bytes(const struct resonator_board *board)
{
    return (uint32_t)board->queue.chunk_count * RESONATOR_CHUNK_BYTES;
}
