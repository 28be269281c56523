#include "resonator_queue.h"

static uint32_t chunks_for(uint32_t size_bytes)
{
    return (size_bytes + RESONATOR_CHUNK_BYTES - 1) / RESONATOR_CHUNK_BYTES;
}

static void release_chunk(struct resonator_queue *queue, uint16_t chunk)
{
    queue->chunks[chunk].next_chunk = queue->first_free;
    queue->first_free = chunk;
    queue->free_count++;
}

static void release_packet(struct resonator_queue *queue, uint16_t chunk)
{
    while (chunk != RESONATOR_NO_CHUNK) {
        uint16_t next = queue->chunks[chunk].next_chunk;
        release_chunk(queue, chunk);
        chunk = next;
    }
}

void resonator_queue_init(struct resonator_queue *queue, struct resonator_chunk *chunks, uint16_t chunk_count)
{
    queue->chunks = chunks;
    queue->chunk_count = chunk_count;
    resonator_queue_clear(queue);
}

void resonator_queue_clear(struct resonator_queue *queue)
{
    queue->free_count = 0;
    queue->first_free = RESONATOR_NO_CHUNK;
    for (uint16_t chunk = queue->chunk_count; chunk > 0; chunk--) {
        release_chunk(queue, (uint16_t)(chunk - 1));
    }
    queue->first_packet = RESONATOR_NO_CHUNK;
    queue->last_packet = RESONATOR_NO_CHUNK;
    queue->read_chunk = RESONATOR_NO_CHUNK;
    queue->read_bytes = 0;
}

bool resonator_queue_fits(const struct resonator_queue *queue, uint32_t size_bytes)
{
    return chunks_for(size_bytes) <= queue->free_count;
}

uint16_t resonator_queue_append(struct resonator_queue *queue, enum resonator_queue_kind kind, uint16_t size_bytes)
{
    uint16_t first = queue->first_free;
    uint16_t last = first;
    uint16_t count = (uint16_t)chunks_for(size_bytes);
    for (uint16_t more = count; more > 1; more--) {
        last = queue->chunks[last].next_chunk;
    }
    queue->first_free = queue->chunks[last].next_chunk;
    queue->free_count = (uint16_t)(queue->free_count - count);

    struct resonator_chunk *packet = &queue->chunks[first];
    queue->chunks[last].next_chunk = RESONATOR_NO_CHUNK;
    packet->next_packet = RESONATOR_NO_CHUNK;
    packet->size_bytes = size_bytes;
    packet->kind = (uint8_t)kind;
    packet->begun = 0;
    packet->skipped_before = 0;
    if (queue->last_packet == RESONATOR_NO_CHUNK) {
        queue->first_packet = first;
        queue->read_chunk = first;
    } else {
        queue->chunks[queue->last_packet].next_packet = first;
    }
    queue->last_packet = first;
    return first;
}

uint16_t resonator_queue_oldest_frame(const struct resonator_queue *queue)
{
    uint16_t packet = queue->first_packet;
    while (packet != RESONATOR_NO_CHUNK &&
           (queue->chunks[packet].kind != RESONATOR_KIND_FRAME || queue->chunks[packet].begun != 0)) {
        packet = queue->chunks[packet].next_packet;
    }
    return packet;
}

void resonator_queue_drop_oldest_frame(struct resonator_queue *queue)
{
    uint16_t oldest = resonator_queue_oldest_frame(queue);
    uint16_t before = RESONATOR_NO_CHUNK;
    uint16_t packet = queue->first_packet;
    bool in_frame = false;
    while (packet != RESONATOR_NO_CHUNK) {
        struct resonator_chunk *head = &queue->chunks[packet];
        uint16_t next = head->next_packet;
        if (head->kind == RESONATOR_KIND_FRAME) {
            if (in_frame) {
                break;
            }
            in_frame = packet == oldest;
        }
        if (!in_frame || head->kind == RESONATOR_KIND_ANSWER) {
            before = packet; /* stays */
        } else {
            if (before == RESONATOR_NO_CHUNK) {
                queue->first_packet = next;
                queue->read_chunk = next;
            } else {
                queue->chunks[before].next_packet = next;
            }
            if (queue->last_packet == packet) {
                queue->last_packet = before;
            }
            release_packet(queue, packet);
        }
        packet = next;
    }
}

uint16_t resonator_queue_peek(struct resonator_queue *queue, const uint8_t **bytes)
{
    if (queue->first_packet == RESONATOR_NO_CHUNK) {
        return 0;
    }
    struct resonator_chunk *packet = &queue->chunks[queue->first_packet];
    uint16_t in_chunk = (uint16_t)(queue->read_bytes % RESONATOR_CHUNK_BYTES);
    uint16_t left_in_chunk = (uint16_t)(RESONATOR_CHUNK_BYTES - in_chunk);
    uint16_t left_in_packet = (uint16_t)(packet->size_bytes - queue->read_bytes);
    packet->begun = 1;
    *bytes = queue->chunks[queue->read_chunk].bytes + in_chunk;
    return left_in_packet < left_in_chunk ? left_in_packet : left_in_chunk;
}

void resonator_queue_consume(struct resonator_queue *queue, uint16_t size_bytes)
{
    uint16_t first = queue->first_packet;
    if (first == RESONATOR_NO_CHUNK) {
        return;
    }
    queue->read_bytes = (uint16_t)(queue->read_bytes + size_bytes);
    if (queue->read_bytes == queue->chunks[first].size_bytes) {
        queue->first_packet = queue->chunks[first].next_packet;
        if (queue->first_packet == RESONATOR_NO_CHUNK) {
            queue->last_packet = RESONATOR_NO_CHUNK;
        }
        queue->read_chunk = queue->first_packet;
        queue->read_bytes = 0;
        release_packet(queue, first);
    } else if (size_bytes > 0 && queue->read_bytes % RESONATOR_CHUNK_BYTES == 0) {
        queue->read_chunk = queue->chunks[queue->read_chunk].next_chunk;
    }
}
