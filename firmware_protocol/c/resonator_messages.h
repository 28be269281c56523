/* Inside of resonator_board.c: writing packets and messages piece by piece, and reading a list of fields. */
#ifndef RESONATOR_MESSAGES_H
#define RESONATOR_MESSAGES_H

#include "resonator_packets.h"
#include "resonator_queue.h"

enum resonator_message_type {
    RESONATOR_IDENTIFY = 0x01,
    RESONATOR_DESCRIBE = 0x02,
    RESONATOR_CONFIGURE = 0x03,
    RESONATOR_START = 0x04,
    RESONATOR_STOP = 0x05,
    RESONATOR_PING = 0x06,
    RESONATOR_LOCATE = 0x07,
    RESONATOR_FRAME = 0x90,
    RESONATOR_FRAME_PART = 0x91,
    RESONATOR_STATUS = 0x92,
    RESONATOR_LOG = 0x93,
    RESONATOR_REFUSED = 0x9F
};

/* Where bytes go: into a packet of the queue, into plain memory, or nowhere, to be counted. */
struct resonator_sink {
    struct resonator_queue *queue; /* NULL: not into the queue */
    uint16_t chunk;
    uint8_t *at; /* NULL: only counts */
    uint32_t room_bytes;
    uint32_t size_bytes;
    uint32_t crc;
};

/* Writes a payload. It is called twice: to count, then to write. */
typedef void (*resonator_payload)(struct resonator_sink *sink, const void *what);

struct resonator_head {
    uint8_t type;
    uint32_t sequence;
    uint64_t board_ticks;
    uint32_t boot_id;
};

void resonator_put(struct resonator_sink *sink, const uint8_t *bytes, uint32_t size);
void resonator_put_number(struct resonator_sink *sink, uint8_t tag, uint64_t value);
void resonator_put_text(struct resonator_sink *sink, uint8_t tag, const char *text);

/* Writes `size` bytes of a number, lowest first. */
void resonator_store(uint8_t *bytes, uint64_t value, uint32_t size);

uint32_t resonator_payload_bytes(resonator_payload payload, const void *what);

/* Appends a packet that fits to the queue; returns its first chunk. */
uint16_t resonator_queue_packet(struct resonator_queue *queue, enum resonator_queue_kind kind,
                                const struct resonator_head *head, resonator_payload payload, const void *what);

/* Writes a packet to memory that holds it; returns its size. */
uint32_t resonator_write_packet(uint8_t *memory, uint32_t memory_bytes, const struct resonator_head *head,
                                resonator_payload payload, const void *what);

/* Finds the last number under a tag in a list of fields. False: the list is malformed or has none. */
bool resonator_find_number(const uint8_t *payload, uint32_t size, uint8_t tag, uint64_t *value);

/* A text with numbers in it, put together. */
#define RESONATOR_TEXT_BYTES 96
struct resonator_text {
    char characters[RESONATOR_TEXT_BYTES];
    uint32_t size;
};

void resonator_text_begin(struct resonator_text *text, const char *words);
void resonator_text_add(struct resonator_text *text, const char *words);
void resonator_text_add_number(struct resonator_text *text, uint64_t value);
void resonator_text_add_hex(struct resonator_text *text, uint8_t value);

#endif
