#include "resonator_payloads.h"

void resonator_put_nothing(struct resonator_sink *sink, const void *what)
{
    (void)sink;
    (void)what;
}

void resonator_put_identity(struct resonator_sink *sink, const void *what)
{
    const struct resonator_board *board = what;
    resonator_put_text(sink, 1, board->identity->product);
    resonator_put_text(sink, 2, board->identity->serial_number);
    resonator_put_text(sink, 3, board->identity->firmware);
    resonator_put_number(sink, 4, RESONATOR_PROTOCOL_MINOR);
    resonator_put_number(sink, 5, board->decoder.capacity_bytes);
    resonator_put_number(sink, 6, board->identity->reset_cause);
}

void resonator_put_description(struct resonator_sink *sink, const void *what)
{
    const struct resonator_board *board = what;
    const struct resonator_description *description = board->description;
    resonator_put_number(sink, 1, description->counter_kind);
    resonator_put_number(sink, 2, RESONATOR_CHANNELS);
    resonator_put_number(sink, 3, description->tones);
    resonator_put_number(sink, 4, description->reference_millihertz);
    resonator_put_number(sink, 5, description->gate_ticks_min);
    resonator_put_number(sink, 6, description->gate_ticks_max);
    resonator_put_text(sink, 7, description->plate);
    resonator_put_number(sink, 8, description->oscillator_millihertz);
    resonator_put_number(sink, 9, description->oscillator_spacing_millihertz);
    resonator_put_number(sink, 10, resonator_queue_bytes(board));
    resonator_put_number(sink, 11, description->capabilities);
    resonator_put_number(sink, 12, description->gate_ticks_step);
}

void resonator_put_configuration(struct resonator_sink *sink, const void *what)
{
    resonator_put_number(sink, 1, *(const uint64_t *)what);
}

void resonator_put_payload_again(struct resonator_sink *sink, const void *what)
{
    const struct resonator_packet *request = what;
    resonator_put(sink, request->payload, request->payload_bytes);
}

void resonator_put_refusal(struct resonator_sink *sink, const void *what)
{
    const struct resonator_refusal *refusal = what;
    resonator_put_number(sink, 1, refusal->code);
    resonator_put_text(sink, 2, refusal->text);
}

void resonator_put_log(struct resonator_sink *sink, const void *what)
{
    const struct resonator_log_line *line = what;
    resonator_put_number(sink, 1, line->level);
    resonator_put_text(sink, 2, line->text);
}

void resonator_put_status(struct resonator_sink *sink, const void *what)
{
    const struct resonator_status_values *status = what;
    resonator_put_number(sink, 1, status->frames_dropped);
    if (status->temperature_known) {
        resonator_put_number(sink, 2, status->temperature_millikelvin);
    }
    resonator_put_number(sink, 3, status->bytes_discarded);
}

void resonator_put_records(struct resonator_sink *sink, const void *what)
{
    const struct resonator_record *records = what;
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++) {
        const struct resonator_record *record = &records[channel];
        uint8_t bytes[RESONATOR_RECORD_BYTES];
        resonator_store(bytes, record->first_edge, 4);
        resonator_store(bytes + 4, record->first_ticks, 4);
        resonator_store(bytes + 8, record->stamps, 2);
        resonator_store(bytes + 10, record->stride_edges, 2);
        resonator_store(bytes + 12, record->span_ticks, 4);
        resonator_store(bytes + 16, record->s1_ticks, 8);
        resonator_store(bytes + 24, record->s2_ticks, 8);
        resonator_store(bytes + 32, record->q2_ticks2, 8);
        resonator_store(bytes + 40, record->attenuation_db256, 2);
        resonator_store(bytes + 42, record->flags, 2);
        resonator_put(sink, bytes, RESONATOR_RECORD_BYTES);
    }
}

void resonator_put_part(struct resonator_sink *sink, const void *what)
{
    const struct resonator_part *part = what;
    const struct resonator_block *block = part->block;
    uint8_t bytes[RESONATOR_PART_HEAD_BYTES];
    bytes[0] = block->channel;
    bytes[1] = 0; /* encoding: 12 bytes a tone */
    resonator_store(bytes + 2, block->first_tone, 2);
    resonator_store(bytes + 4, block->tones, 2);
    bytes[6] = block->part;
    bytes[7] = block->parts;
    resonator_put(sink, bytes, sizeof bytes);
    resonator_put(sink, part->tones, (uint32_t)block->tones * RESONATOR_TONE_BYTES);
}
