/* Feeds a board and a lone decoder seeded inputs made from valid packets, and checks accounts and bounds after each.
 *
 *   fuzz INPUTS SEED
 *
 * An input is one call: received bytes (sound, mutated, spliced, random), a frame, a part, output, a new host. Prints
 * what came of them. Ends with status 1 and a line at the first thing that must not be; sanitizers end it too.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "resonator_board.h"

#define INPUT_BYTES 96
#define CHUNKS 24
#define MAX_STREAM 480 /* three of the longest pieces */
#define MAX_TONES 40

static uint64_t random_state;
static uint64_t packets_seen, damages_seen, damaged_bytes_seen;

static uint32_t drawn(uint32_t below)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return (uint32_t)((random_state >> 20) % below);
}

static void demand(bool holds, const char *what)
{
    if (!holds) {
        printf("fuzz: %s\n", what);
        exit(1);
    }
}

static void count_packet(void *context, const struct resonator_packet *packet)
{
    uint32_t sum = 0;
    (void)context;
    for (uint32_t i = 0; i < packet->payload_bytes; i++) {
        sum += packet->payload[i]; /* touches every byte, for the sanitizer */
    }
    packets_seen += 1 + (sum & 0u);
}

static void count_damage(void *context, enum resonator_defect defect, uint64_t size_bytes)
{
    (void)context;
    demand(defect >= RESONATOR_GARBAGE && defect <= RESONATOR_BAD_CRC, "a defect that is none");
    demand(size_bytes > 0, "damage of no bytes");
    damages_seen++;
    damaged_bytes_seen += size_bytes;
}

static void store(uint8_t *to, uint64_t value, uint32_t size)
{
    for (uint32_t i = 0; i < size; i++) {
        to[i] = (uint8_t)value;
        value >>= 8;
    }
}

static uint32_t make_packet(uint8_t *to)
{
    uint32_t payload_bytes = drawn(4) == 0 ? drawn(80) : drawn(12);
    uint32_t odd = drawn(16);
    uint8_t type = (uint8_t)(odd == 0 ? drawn(256) : odd == 1 ? 0x80 + drawn(8) : 1 + drawn(7));
    to[0] = 0xA5;
    to[1] = 0x5A;
    to[2] = (uint8_t)(drawn(16) == 0 ? drawn(4) : 1);
    to[3] = type;
    store(to + 4, drawn(UINT32_MAX), 4);
    store(to + 8, 0, 12);
    if (type == 3 && drawn(4) > 0) { /* a sound CONFIGURE most of the time */
        payload_bytes = 2 + drawn(3);
        to[24] = 1;
        to[25] = (uint8_t)(payload_bytes - 2);
        store(to + 26, drawn(UINT32_MAX), 4);
    } else {
        for (uint32_t i = 0; i < payload_bytes; i++) {
            to[24 + i] = (uint8_t)(drawn(4) == 0 ? (drawn(2) ? 0xA5 : 0x5A) : drawn(256));
        }
        if (type == 6 && drawn(4) > 0) {
            payload_bytes = 8;
        }
    }
    store(to + 20, drawn(64) == 0 ? drawn(65536) : payload_bytes, 2);
    store(to + 22, resonator_crc16(0xFFFF, to, 22), 2);
    store(to + 24 + payload_bytes, ~resonator_crc32(0xFFFFFFFF, to, 24 + payload_bytes), 4);
    return payload_bytes + 28;
}

static uint32_t make_stream(uint8_t *to)
{
    uint32_t size = 0;
    uint32_t pieces = 1 + drawn(3);
    for (uint32_t piece = 0; piece < pieces && size < MAX_STREAM - 160; piece++) {
        uint32_t begun = size;
        if (drawn(8) == 0) {
            for (uint32_t i = drawn(40); i > 0; i--) {
                to[size++] = (uint8_t)(drawn(3) == 0 ? (drawn(2) ? 0xA5 : 0x5A) : drawn(256));
            }
            continue;
        }
        size += make_packet(to + size);
        switch (drawn(8)) {
        case 0:
            to[begun + drawn(size - begun)] ^= (uint8_t)(1u << drawn(8));
            break;
        case 1:
            size = begun + drawn(size - begun); /* cut off */
            break;
        case 2:
            store(to + begun + drawn(size - begun - 8), random_state, 1 + drawn(8));
            break;
        default:
            break;
        }
    }
    return size;
}

static void check_decoder(const struct resonator_decoder *decoder, uint64_t received)
{
    const struct resonator_byte_counts *counts = &decoder->counts;
    demand(counts->received == received, "received bytes are miscounted");
    demand(counts->received == counts->accepted + counts->other_version + counts->echo + counts->discarded +
                                   decoder->waiting_bytes,
           "bytes do not add up");
    demand(decoder->waiting_bytes < decoder->capacity_bytes, "more waits than a packet has");
}

static void check_queue(const struct resonator_board *board)
{
    const struct resonator_queue *queue = &board->queue;
    uint32_t used = 0;
    uint32_t last = RESONATOR_NO_CHUNK;
    for (uint16_t packet = queue->first_packet; packet != RESONATOR_NO_CHUNK;
         packet = queue->chunks[packet].next_packet) {
        uint32_t chunks = 0;
        for (uint16_t chunk = packet; chunk != RESONATOR_NO_CHUNK; chunk = queue->chunks[chunk].next_chunk) {
            chunks++;
            demand(chunks <= CHUNKS, "a packet's chunks go round in a circle");
        }
        demand(chunks == (queue->chunks[packet].size_bytes + RESONATOR_CHUNK_BYTES - 1u) / RESONATOR_CHUNK_BYTES,
               "a packet has another number of chunks than it needs");
        used += chunks;
        demand(used <= CHUNKS, "the queue goes round in a circle");
        last = packet;
    }
    demand(queue->last_packet == last, "the queue's end is lost");
    uint32_t free = 0;
    for (uint16_t chunk = queue->first_free; chunk != RESONATOR_NO_CHUNK; chunk = queue->chunks[chunk].next_chunk) {
        free++;
        demand(free <= CHUNKS, "free chunks go round in a circle");
    }
    demand(free == queue->free_count && free + used == CHUNKS, "chunks are lost");
}

int main(int count, char **words)
{
    static const struct resonator_identity identity = {"fuzz", "0", "1", 0};
    static const struct resonator_description description = {1, MAX_TONES, 1000, 1, 1000000, 1, "plate", 0, 0, 2};
    static const struct resonator_record records[RESONATOR_CHANNELS];
    static struct resonator_board board;
    static struct resonator_decoder sent; /* reads what the board sends */
    const struct resonator_decoder_handler handler = {NULL, count_packet, count_damage};
    const struct resonator_watcher watcher = {NULL, count_packet, count_damage};
    if (count != 3) {
        fprintf(stderr, "usage: fuzz INPUTS SEED\n");
        return 2;
    }
    uint64_t inputs = strtoull(words[1], NULL, 10);
    random_state = strtoull(words[2], NULL, 10) * 0x9E3779B97F4A7C15u | 1u;
    /* On the heap, each by itself: a step beyond an end is seen. */
    struct resonator_memory memory = {malloc(INPUT_BYTES), INPUT_BYTES, malloc(CHUNKS * sizeof *memory.chunks), CHUNKS};
    uint8_t *sent_buffer = malloc(RESONATOR_MAX_PACKET_BYTES);
    uint8_t *tones = calloc(MAX_TONES, RESONATOR_TONE_BYTES);
    demand(resonator_init(&board, &identity, &description, 1, &memory), "a sound board is refused");
    board.watcher = &watcher;
    resonator_decoder_init(&sent, RESONATOR_FROM_BOARD, sent_buffer, RESONATOR_MAX_PACKET_BYTES);
    uint64_t received = 0, sent_bytes = 0, abandoned = 0;
    uint32_t part = 0, parts = 1;
    for (uint64_t input = 0; input < inputs; input++) {
        uint32_t kind = drawn(32);
        if (kind < 20) {
            uint8_t *stream = malloc(MAX_STREAM);
            uint32_t size = make_stream(stream);
            uint32_t cut = drawn(size + 1);
            resonator_receive(&board, stream, cut, input);
            resonator_receive(&board, stream + cut, size - cut, input);
            received += size;
            free(stream);
        } else if (kind < 24) {
            (void)resonator_frame(&board, input, records);
        } else if (kind < 26) {
            if (part == 0) {
                parts = 1 + drawn(6);
            }
            struct resonator_block block = {0, 0, (uint16_t)drawn(MAX_TONES + 1), (uint8_t)part, (uint8_t)parts};
            (void)resonator_frame_part(&board, input, &block, tones);
            part = part + 1 == parts ? 0 : part + 1;
        } else if (kind < 30) {
            uint32_t left = drawn(1200);
            const uint8_t *ready;
            uint16_t size;
            while (left > 0 && (size = resonator_output(&board, &ready)) > 0) {
                uint16_t piece = size < left ? size : (uint16_t)left;
                resonator_decoder_feed(&sent, ready, piece, &handler);
                resonator_consumed(&board, piece);
                sent_bytes += piece;
                left -= piece;
            }
        } else if (kind == 30) {
            switch (drawn(5)) {
            case 0:
                resonator_frame_skipped(&board);
                break;
            case 1:
                resonator_status(&board);
                break;
            case 2:
                (void)resonator_log(&board, input, RESONATOR_LOG_INFO, "a line");
                break;
            case 3:
                resonator_fault(&board, input, drawn(2) ? "fault" : NULL);
                break;
            default:
                resonator_temperature(&board, drawn(400000));
                break;
            }
        } else if (drawn(16) == 0) {
            uint32_t way = drawn(3);
            if (way == 0) {
                resonator_begin(&board);
            } else if (way == 1) {
                resonator_connection_ended(&board);
            }
            if (way < 2 || resonator_host_connects(&board, input)) {
                abandoned += sent.waiting_bytes;
                resonator_decoder_abandon(&sent); /* the rest of a packet will not come */
            }
        }
        check_decoder(&board.decoder, received);
        check_queue(&board);
        check_decoder(&sent, sent_bytes);
        demand(sent.counts.discarded == abandoned, "the board sent what is no packet");
    }
    demand(sent.counts.echo == 0 && sent.counts.other_version == 0, "the board sent what is not a board's");
    printf("inputs %" PRIu64 ", bytes in %" PRIu64 " (accepted %" PRIu64 ", other version %" PRIu64 ", echo %" PRIu64
           ", discarded %" PRIu64 "), packets %" PRIu64 ", damages %" PRIu64 " of %" PRIu64 " bytes\n",
           inputs, received, board.decoder.counts.accepted, board.decoder.counts.other_version,
           board.decoder.counts.echo, board.decoder.counts.discarded, packets_seen, damages_seen,
           damaged_bytes_seen);
    printf("runs %" PRIu32 ", bytes out %" PRIu64 " (sound %" PRIu64 ", of packets that a new host cut %" PRIu64
           "), dropped: frames %" PRIu64 ", parts %" PRIu64 ", answers %" PRIu64 "\n",
           board.started, sent_bytes, sent.counts.accepted, abandoned, board.output_counts.frames_dropped,
           board.output_counts.parts_dropped, board.output_counts.answers_dropped);
    free(memory.input);
    free(memory.chunks);
    free(sent_buffer);
    free(tones);
    return 0;
}
