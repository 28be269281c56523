/* Runs the reference by commands, one a line on standard input, and prints what comes of them: for tests.
 *
 *   decoder DIRECTION CAPACITY_BYTES              a decoder alone; only `receive`, `abandon`, `counts` then
 *   board BOOT_ID INPUT_BYTES CHUNKS KIND TONES REFERENCE MIN MAX STEP OSCILLATOR SPACING CAPABILITIES RESET_CAUSE
 *         PRODUCT SERIAL FIRMWARE PLATE            texts in hex, "-" for none; prints "ok" or "bad"
 *   receive TICKS HEX                             prints the events
 *   output BYTES                                  consumes at most so many; prints "output HEX"
 *   hand                                          asks for output and consumes none; prints "hand BYTES"
 *   consumed BYTES                                says that so many of those were sent
 *   frame TICKS HEX, part TICKS CHANNEL FIRST TONES PART PARTS HEX     prints "queued 0" or "queued 1"
 *   log TICKS LEVEL HEX                           the same
 *   skipped | status | temperature MILLIKELVIN | fault TICKS HEX | begin | ended | abandon
 *   connects TICKS                                prints "served 0" or "served 1"
 *   sums STRIDE HEX                               stamps, 8 bytes each: edge, ticks; prints "sums" and the record
 *   counts                                        bytes: received accepted other own discarded waiting
 *   state                                         state gate_ticks started located, dropped: frames parts answers logs
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "resonator_board.h"
#include "resonator_sums.h"

#define MAX_LINE 1100000 /* 65536 stamps in hex */

static struct resonator_board board;
static struct resonator_decoder lone_decoder;
static struct resonator_decoder *decoder = &lone_decoder;
static uint8_t *input;
static struct resonator_chunk *chunks;
static char texts[5][1024];
static struct resonator_identity identity;
static struct resonator_description description;

static char *word(void)
{
    char *found = strtok(NULL, " \n");
    if (found == NULL) {
        fprintf(stderr, "driver: a word is missing\n");
        exit(2);
    }
    return found;
}

static uint64_t number(void)
{
    return strtoull(word(), NULL, 10);
}

/* Into memory of exactly that size, so that a sanitizer sees a step beyond its end. */
static uint8_t *bytes(uint32_t *size)
{
    const char *hex = word();
    *size = hex[0] == '-' ? 0 : (uint32_t)(strlen(hex) / 2);
    uint8_t *made = malloc(*size > 0 ? *size : 1);
    for (uint32_t i = 0; i < *size; i++) {
        char pair[3] = {hex[2 * i], hex[2 * i + 1], 0};
        made[i] = (uint8_t)strtoul(pair, NULL, 16);
    }
    return made;
}

static const char *text(char *into)
{
    uint32_t size;
    uint8_t *made = bytes(&size);
    memcpy(into, made, size);
    into[size] = 0;
    free(made);
    return into;
}

static void print_hex(const uint8_t *from, uint32_t size)
{
    for (uint32_t i = 0; i < size; i++) {
        printf("%02x", from[i]);
    }
}

static void print_packet(void *context, const struct resonator_packet *packet)
{
    (void)context;
    if (packet->major != RESONATOR_PROTOCOL_MAJOR) {
        printf("foreign %u %u %" PRIu32 "\n", packet->major, packet->type, packet->sequence);
        return;
    }
    printf("packet %u %" PRIu32 " %" PRIu64 " %" PRIu32 " ", packet->type, packet->sequence, packet->board_ticks,
           packet->boot_id);
    print_hex(packet->payload, packet->payload_bytes);
    printf("\n");
}

static void print_damage(void *context, enum resonator_defect defect, uint64_t size_bytes)
{
    static const char *const names[] = {"garbage", "bad_header", "bad_length", "bad_crc"};
    (void)context;
    printf("damage %s %" PRIu64 "\n", names[defect], size_bytes);
}

static const struct resonator_watcher watcher = {NULL, print_packet, print_damage};
static const struct resonator_decoder_handler handler = {NULL, print_packet, print_damage};

static void make_decoder(void)
{
    uint8_t direction = (uint8_t)number();
    uint16_t capacity_bytes = (uint16_t)number();
    free(input);
    input = malloc(capacity_bytes);
    decoder = &lone_decoder;
    resonator_decoder_init(decoder, direction, input, capacity_bytes);
}

static void make_board(void)
{
    uint32_t boot_id = (uint32_t)number();
    struct resonator_memory memory;
    memory.input_bytes = (uint16_t)number();
    memory.chunk_count = (uint16_t)number();
    description.counter_kind = (uint8_t)number();
    description.tones = (uint16_t)number();
    description.reference_millihertz = number();
    description.gate_ticks_min = number();
    description.gate_ticks_max = number();
    description.gate_ticks_step = number();
    description.oscillator_millihertz = number();
    description.oscillator_spacing_millihertz = number();
    description.capabilities = number();
    identity.reset_cause = (uint8_t)number();
    identity.product = text(texts[0]);
    identity.serial_number = text(texts[1]);
    identity.firmware = text(texts[2]);
    description.plate = text(texts[3]);
    free(input);
    free(chunks);
    memory.input = input = malloc(memory.input_bytes > 0 ? memory.input_bytes : 1);
    memory.chunks = chunks = malloc((memory.chunk_count + 1u) * sizeof *chunks);
    bool sound = resonator_init(&board, &identity, &description, boot_id, &memory);
    board.watcher = &watcher;
    decoder = &board.decoder;
    printf(sound ? "ok\n" : "bad\n");
}

static void receive(void)
{
    uint64_t ticks = number();
    uint32_t size;
    uint8_t *received = bytes(&size);
    if (decoder == &lone_decoder) {
        resonator_decoder_feed(decoder, received, size, &handler);
    } else {
        resonator_receive(&board, received, size, ticks);
    }
    free(received);
}

static void output(void)
{
    uint64_t left = number();
    const uint8_t *ready;
    uint16_t size;
    printf("output ");
    while (left > 0 && (size = resonator_output(&board, &ready)) > 0) {
        uint16_t piece = size < left ? size : (uint16_t)left;
        print_hex(ready, piece);
        resonator_consumed(&board, piece);
        left -= piece;
    }
    printf("\n");
}

static uint64_t loaded(const uint8_t *from, uint32_t size)
{
    uint64_t value = 0;
    while (size-- > 0) {
        value = value << 8 | from[size];
    }
    return value;
}

static void frame(void)
{
    uint64_t ticks = number();
    uint32_t size;
    uint8_t *raw = bytes(&size);
    struct resonator_record records[RESONATOR_CHANNELS];
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++) {
        const uint8_t *from = raw + channel * RESONATOR_RECORD_BYTES;
        struct resonator_record *record = &records[channel];
        record->first_edge = (uint32_t)loaded(from, 4);
        record->first_ticks = (uint32_t)loaded(from + 4, 4);
        record->stamps = (uint16_t)loaded(from + 8, 2);
        record->stride_edges = (uint16_t)loaded(from + 10, 2);
        record->span_ticks = (uint32_t)loaded(from + 12, 4);
        record->s1_ticks = loaded(from + 16, 8);
        record->s2_ticks = loaded(from + 24, 8);
        record->q2_ticks2 = loaded(from + 32, 8);
        record->attenuation_db256 = (uint16_t)loaded(from + 40, 2);
        record->flags = (uint16_t)loaded(from + 42, 2);
    }
    printf("queued %d\n", resonator_frame(&board, ticks, records));
    free(raw);
}

static void frame_part(void)
{
    uint64_t ticks = number();
    struct resonator_block block;
    block.channel = (uint8_t)number();
    block.first_tone = (uint16_t)number();
    block.tones = (uint16_t)number();
    block.part = (uint8_t)number();
    block.parts = (uint8_t)number();
    uint32_t size;
    uint8_t *tones = bytes(&size);
    printf("queued %d\n", resonator_frame_part(&board, ticks, &block, tones));
    free(tones);
}

static void sum_up(void)
{
    uint16_t stride_edges = (uint16_t)number();
    uint32_t size;
    uint8_t *stamps = bytes(&size);
    struct resonator_sums sums;
    struct resonator_record record;
    bool all = true;
    resonator_sums_begin(&sums);
    for (uint32_t at = 0; at < size; at += 8) {
        all &= resonator_sums_add(&sums, (uint32_t)loaded(stamps + at, 4), (uint32_t)loaded(stamps + at + 4, 4));
    }
    resonator_sums_record(&sums, stride_edges, &record);
    printf("sums %" PRIu32 " %" PRIu32 " %u %u %" PRIu32 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %d\n", record.first_edge,
           record.first_ticks, record.stamps, record.stride_edges, record.span_ticks, record.s1_ticks,
           record.s2_ticks, record.q2_ticks2, all);
    free(stamps);
}

static void log_line(void)
{
    char line[1024];
    uint64_t ticks = number();
    enum resonator_log_level level = (enum resonator_log_level)number();
    printf("queued %d\n", resonator_log(&board, ticks, level, text(line)));
}

static void fault(void)
{
    uint64_t ticks = number();
    const char *why = text(texts[4]);
    resonator_fault(&board, ticks, why[0] == 0 ? NULL : why);
}

static void print_counts(void)
{
    const struct resonator_byte_counts *counts = &decoder->counts;
    printf("counts %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %u\n", counts->received,
           counts->accepted, counts->other_version, counts->echo, counts->discarded, decoder->waiting_bytes);
}

static void print_state(void)
{
    static const char *const names[] = {"idle", "configured", "running"};
    const struct resonator_output_counts *lost = &board.output_counts;
    printf("state %s %" PRIu64 " %" PRIu32 " %" PRIu32 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 "\n",
           names[board.state], board.gate_ticks, board.started, board.located, lost->frames_dropped,
           lost->parts_dropped, lost->answers_dropped, lost->logs_dropped);
}

static void hand(void)
{
    const uint8_t *ready;
    printf("hand %u\n", resonator_output(&board, &ready));
}

static void carry_out(const char *command)
{
    static const struct {
        const char *name;
        void (*function)(void);
    } commands[] = {{"decoder", make_decoder}, {"board", make_board}, {"receive", receive},    {"output", output},
                    {"hand", hand},            {"frame", frame},      {"part", frame_part},    {"log", log_line},
                    {"fault", fault},          {"counts", print_counts}, {"state", print_state},
                    {"sums", sum_up}};
    for (size_t i = 0; i < sizeof commands / sizeof commands[0]; i++) {
        if (strcmp(command, commands[i].name) == 0) {
            commands[i].function();
            return;
        }
    }
    if (strcmp(command, "skipped") == 0) {
        resonator_frame_skipped(&board);
    } else if (strcmp(command, "status") == 0) {
        resonator_status(&board);
    } else if (strcmp(command, "temperature") == 0) {
        resonator_temperature(&board, (uint32_t)number());
    } else if (strcmp(command, "consumed") == 0) {
        resonator_consumed(&board, (uint16_t)number());
    } else if (strcmp(command, "begin") == 0) {
        resonator_begin(&board);
    } else if (strcmp(command, "ended") == 0) {
        resonator_connection_ended(&board);
    } else if (strcmp(command, "connects") == 0) {
        printf("served %d\n", resonator_host_connects(&board, number()));
    } else if (strcmp(command, "abandon") == 0) {
        resonator_decoder_abandon(decoder);
    } else {
        fprintf(stderr, "driver: unknown command %s\n", command);
        exit(2);
    }
}

int main(void)
{
    static char line[MAX_LINE];
    while (fgets(line, sizeof line, stdin) != NULL) {
        carry_out(strtok(line, " \n"));
    }
    free(input);
    free(chunks);
    return 0;
}
