#include "resonator_board.h"

#include <stddef.h>

#include "resonator_messages.h"
#include "resonator_output.h"
#include "resonator_payloads.h"

#define PING_BYTES 8

static void answer(struct resonator_board *board, uint8_t type, uint32_t sequence, resonator_payload payload,
                   const void *what)
{
    if (!resonator_make_room(board, resonator_payload_bytes(payload, what))) {
        board->output_counts.answers_dropped++;
        return;
    }
    struct resonator_head head = resonator_head_of(board, type, sequence);
    (void)resonator_queue_packet(&board->queue, RESONATOR_KIND_ANSWER, &head, payload, what);
}

static void refuse(struct resonator_board *board, uint32_t sequence, enum resonator_refusal_code code,
                   const char *text)
{
    struct resonator_refusal refusal;
    refusal.code = code;
    refusal.text = text;
    answer(board, RESONATOR_REFUSED, sequence, resonator_put_refusal, &refusal);
}

static void refuse_unknown(struct resonator_board *board, const struct resonator_packet *request)
{
    struct resonator_text text;
    resonator_text_begin(&text, "unknown message 0x");
    resonator_text_add_hex(&text, request->type);
    refuse(board, request->sequence, RESONATOR_REFUSED_UNKNOWN_MESSAGE, text.characters);
}

static void ping(struct resonator_board *board, const struct resonator_packet *request)
{
    if (request->payload_bytes != PING_BYTES) {
        struct resonator_text text;
        resonator_text_begin(&text, "PING needs 8 bytes, got ");
        resonator_text_add_number(&text, request->payload_bytes);
        refuse(board, request->sequence, RESONATOR_REFUSED_MALFORMED, text.characters);
        return;
    }
    answer(board, RESONATOR_PING | RESONATOR_FROM_BOARD, request->sequence, resonator_put_payload_again, request);
}

static void configure(struct resonator_board *board, const struct resonator_packet *request)
{
    const struct resonator_description *limits = board->description;
    uint64_t gate_ticks;
    if (!resonator_find_number(request->payload, request->payload_bytes, 1, &gate_ticks)) {
        refuse(board, request->sequence, RESONATOR_REFUSED_MALFORMED,
               "CONFIGURE needs gate_ticks, a number of 1 to 8 bytes");
        return;
    }
    bool in_range = gate_ticks >= limits->gate_ticks_min && gate_ticks <= limits->gate_ticks_max;
    if (!in_range || gate_ticks % limits->gate_ticks_step != 0) {
        struct resonator_text text;
        resonator_text_begin(&text, "gate_ticks must be ");
        if (in_range) {
            resonator_text_add(&text, "a multiple of ");
            resonator_text_add_number(&text, limits->gate_ticks_step);
        } else {
            resonator_text_add_number(&text, limits->gate_ticks_min);
            resonator_text_add(&text, " to ");
            resonator_text_add_number(&text, limits->gate_ticks_max);
        }
        resonator_text_add(&text, ", got ");
        resonator_text_add_number(&text, gate_ticks);
        refuse(board, request->sequence, RESONATOR_REFUSED_OUT_OF_RANGE, text.characters);
        return;
    }
    board->state = RESONATOR_CONFIGURED;
    board->gate_ticks = gate_ticks;
    answer(board, RESONATOR_CONFIGURE | RESONATOR_FROM_BOARD, request->sequence, resonator_put_configuration,
           &gate_ticks);
}

static void begin_run(struct resonator_board *board)
{
    /* Frames of the last run that still wait have the numbers of those of this one. */
    while (resonator_queue_oldest_frame(&board->queue) != RESONATOR_NO_CHUNK) {
        resonator_queue_drop_oldest_frame(&board->queue);
        board->output_counts.frames_dropped++;
    }
    board->state = RESONATOR_RUNNING;
    board->started++;
    board->frame_sequence = 0;
    board->run_dropped = 0;
    board->run_skipped = 0;
    board->run_reported = 0;
    board->open_frame = RESONATOR_NO_CHUNK;
}

static void start(struct resonator_board *board, const struct resonator_packet *request)
{
    if (board->state == RESONATOR_IDLE) {
        refuse(board, request->sequence, RESONATOR_REFUSED_NOT_IN_THIS_STATE, "START needs a configuration");
        return;
    }
    if (board->fault != NULL) {
        refuse(board, request->sequence, RESONATOR_REFUSED_FAULT, board->fault);
        return;
    }
    if (board->state == RESONATOR_CONFIGURED) {
        begin_run(board);
    }
    answer(board, RESONATOR_START | RESONATOR_FROM_BOARD, request->sequence, resonator_put_nothing, NULL);
}

static void carry_out(struct resonator_board *board, const struct resonator_packet *request)
{
    uint8_t answer_type = request->type | RESONATOR_FROM_BOARD;
    switch (request->type) {
    case RESONATOR_IDENTIFY:
        answer(board, answer_type, request->sequence, resonator_put_identity, board);
        return;
    case RESONATOR_DESCRIBE:
        answer(board, answer_type, request->sequence, resonator_put_description, board);
        return;
    case RESONATOR_CONFIGURE:
        configure(board, request);
        return;
    case RESONATOR_START:
        start(board, request);
        return;
    case RESONATOR_STOP:
        if (board->state == RESONATOR_RUNNING) {
            board->state = RESONATOR_CONFIGURED;
        }
        answer(board, answer_type, request->sequence, resonator_put_nothing, NULL);
        return;
    case RESONATOR_PING:
        ping(board, request);
        return;
    case RESONATOR_LOCATE:
        if ((board->description->capabilities & RESONATOR_CAN_LOCATE) != 0) {
            board->located++;
            answer(board, answer_type, request->sequence, resonator_put_nothing, NULL);
            return;
        }
        break;
    default:
        break;
    }
    refuse_unknown(board, request);
}

static void packet_found(void *context, const struct resonator_packet *packet)
{
    struct resonator_board *board = context;
    if (board->watcher != NULL && board->watcher->packet != NULL) {
        board->watcher->packet(board->watcher->context, packet);
    }
    if (packet->major == RESONATOR_PROTOCOL_MAJOR) {
        board->asked = true;
        carry_out(board, packet);
    } else if ((packet->type & RESONATOR_FROM_BOARD) == 0) {
        struct resonator_text text;
        resonator_text_begin(&text, "this board speaks version ");
        resonator_text_add_number(&text, RESONATOR_PROTOCOL_MAJOR);
        resonator_text_add(&text, ", not ");
        resonator_text_add_number(&text, packet->major);
        refuse(board, packet->sequence, RESONATOR_REFUSED_OTHER_VERSION, text.characters);
    }
}

static void damage_found(void *context, enum resonator_defect defect, uint64_t size_bytes)
{
    const struct resonator_board *board = context;
    if (board->watcher != NULL && board->watcher->damage != NULL) {
        board->watcher->damage(board->watcher->context, defect, size_bytes);
    }
}

/* Of all packets that the host cannot do without. */
static uint32_t longest_packet_bytes(const struct resonator_board *board)
{
    uint32_t identity_bytes = resonator_payload_bytes(resonator_put_identity, board);
    uint32_t longest = resonator_payload_bytes(resonator_put_description, board);
    uint32_t frame_bytes = RESONATOR_CHANNELS * RESONATOR_RECORD_BYTES;
    if (board->description->counter_kind == RESONATOR_CHANNELISED) {
        uint32_t tones = board->description->tones;
        tones = tones < RESONATOR_MAX_TONES_PER_PART ? tones : RESONATOR_MAX_TONES_PER_PART;
        frame_bytes = RESONATOR_PART_HEAD_BYTES + tones * RESONATOR_TONE_BYTES;
    }
    longest = identity_bytes > longest ? identity_bytes : longest;
    return RESONATOR_OVERHEAD_BYTES + (frame_bytes > longest ? frame_bytes : longest);
}

/* It becomes a level of MQTT topics: letters, digits, and -, _ or . behind the first. */
static bool serial_number_is_sound(const char *text)
{
    uint32_t size = 0;
    for (; text[size] != 0; size++) {
        char small = (char)(text[size] | 0x20);
        bool letter = small >= 'a' && small <= 'z';
        bool digit = text[size] >= '0' && text[size] <= '9';
        bool mark = text[size] == '-' || text[size] == '_' || text[size] == '.';
        if (!letter && !digit && !(mark && size > 0)) {
            return false;
        }
    }
    return size > 0 && size <= RESONATOR_MAX_SERIAL_NUMBER;
}

bool resonator_init(struct resonator_board *board, const struct resonator_identity *identity,
                    const struct resonator_description *description, uint32_t boot_id,
                    const struct resonator_memory *memory)
{
    if (boot_id == 0 || memory->input_bytes < RESONATOR_MIN_INPUT_BYTES ||
        memory->input_bytes > RESONATOR_MAX_PACKET_BYTES || memory->chunk_count == RESONATOR_NO_CHUNK ||
        description->gate_ticks_step == 0 || description->gate_ticks_max > UINT32_MAX ||
        description->tones > RESONATOR_MAX_TONES || !serial_number_is_sound(identity->serial_number)) {
        return false;
    }
    resonator_decoder_init(&board->decoder, 0, memory->input, memory->input_bytes);
    resonator_queue_init(&board->queue, memory->chunks, memory->chunk_count);
    board->identity = identity;
    board->description = description;
    if (!resonator_queue_fits(&board->queue, longest_packet_bytes(board))) {
        return false;
    }
    board->boot_id = boot_id;
    board->fault = NULL;
    board->watcher = NULL;
    board->started = 0;
    board->located = 0;
    board->output_counts.frames_dropped = 0;
    board->output_counts.parts_dropped = 0;
    board->output_counts.answers_dropped = 0;
    board->output_counts.logs_dropped = 0;
    board->ticks = 0;
    board->received_ticks = 0;
    board->frame_sequence = 0;
    board->run_dropped = 0;
    board->run_skipped = 0;
    board->run_reported = 0;
    board->open_frame = RESONATOR_NO_CHUNK;
    board->notice_sequence = 0;
    board->temperature_known = false;
    board->temperature_millikelvin = 0;
    resonator_begin(board);
    return true;
}

void resonator_begin(struct resonator_board *board)
{
    resonator_connection_ended(board);
    board->state = RESONATOR_IDLE;
    board->gate_ticks = 0;
}

void resonator_connection_ended(struct resonator_board *board)
{
    resonator_count_queued_as_dropped(board);
    resonator_decoder_abandon(&board->decoder);
    resonator_queue_clear(&board->queue);
    board->asked = false;
    board->connected = false;
    board->open_frame = RESONATOR_NO_CHUNK;
    board->status_due = false;
    board->status_bytes = 0;
    board->status_read_bytes = 0;
}

bool resonator_host_connects(struct resonator_board *board, uint64_t ticks)
{
    uint64_t vanished_ticks = board->description->reference_millihertz / 1000 * RESONATOR_VANISHED_S;
    if (board->connected && ticks - board->received_ticks < vanished_ticks) {
        return false;
    }
    resonator_connection_ended(board);
    board->connected = true;
    board->received_ticks = ticks;
    return true;
}

void resonator_receive(struct resonator_board *board, const uint8_t *bytes, uint32_t size, uint64_t ticks)
{
    struct resonator_decoder_handler handler;
    handler.context = board;
    handler.packet = packet_found;
    handler.damage = damage_found;
    board->ticks = ticks;
    if (size > 0) {
        board->received_ticks = ticks; /* also without a packet: the host is still connected */
    }
    resonator_decoder_feed(&board->decoder, bytes, size, &handler);
}
