/* The output queue: packets in chunks from a pool, so that the oldest frames can be taken out of its middle. */
#ifndef RESONATOR_QUEUE_H
#define RESONATOR_QUEUE_H

#include <stdbool.h>
#include <stdint.h>

#ifndef RESONATOR_CHUNK_BYTES
#define RESONATOR_CHUNK_BYTES 68 /* a frame of 204 bytes fills three */
#endif

#define RESONATOR_NO_CHUNK 0xFFFF

enum resonator_queue_kind {
    RESONATOR_KIND_ANSWER,    /* and LOG: never dropped for a frame */
    RESONATOR_KIND_FRAME,     /* a frame, or the first part of one */
    RESONATOR_KIND_FRAME_MORE /* a further part */
};

/* One piece of the pool. All but next_chunk and bytes mean something in the first chunk of a packet only. */
struct resonator_chunk {
    uint16_t next_chunk;
    uint16_t next_packet;
    uint16_t size_bytes; /* of the packet */
    uint8_t kind;
    uint8_t begun; /* handed out, at least in part: is finished */
    uint32_t skipped_before; /* frames of the run that were skipped before this one was made */
    uint8_t bytes[RESONATOR_CHUNK_BYTES];
};

struct resonator_queue {
    struct resonator_chunk *chunks;
    uint16_t chunk_count;
    uint16_t free_count;
    uint16_t first_free;
    uint16_t first_packet;
    uint16_t last_packet;
    uint16_t read_chunk; /* of the first packet */
    uint16_t read_bytes; /* of the first packet that are consumed */
};

void resonator_queue_init(struct resonator_queue *queue, struct resonator_chunk *chunks, uint16_t chunk_count);

void resonator_queue_clear(struct resonator_queue *queue);

/* Whether a packet of so many bytes finds room now. */
bool resonator_queue_fits(const struct resonator_queue *queue, uint32_t size_bytes);

/* Appends a packet that fits, to be filled chunk by chunk along next_chunk; returns its first chunk. */
uint16_t resonator_queue_append(struct resonator_queue *queue, enum resonator_queue_kind kind, uint16_t size_bytes);

/* The oldest frame of which no byte was handed out; RESONATOR_NO_CHUNK if there is none. */
uint16_t resonator_queue_oldest_frame(const struct resonator_queue *queue);

/* Takes that frame out, with all its parts. */
void resonator_queue_drop_oldest_frame(struct resonator_queue *queue);

/* Hands out the rest of the first packet's present chunk; 0 bytes when the queue is empty. */
uint16_t resonator_queue_peek(struct resonator_queue *queue, const uint8_t **bytes);

/* So many of the bytes last handed out are done with; 0 is harmless. */
void resonator_queue_consume(struct resonator_queue *queue, uint16_t size_bytes);

#endif
