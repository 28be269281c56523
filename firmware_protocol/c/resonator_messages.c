#include "resonator_messages.h"

#include <stddef.h>

#define MAX_TEXT_BYTES 255
#define MAX_NUMBER_BYTES 8

void resonator_put(struct resonator_sink *sink, const uint8_t *bytes, uint32_t size)
{
    sink->size_bytes += size;
    if (sink->at == NULL) {
        return;
    }
    sink->crc = resonator_crc32(sink->crc, bytes, size);
    while (size > 0) {
        if (sink->room_bytes == 0) {
            sink->chunk = sink->queue->chunks[sink->chunk].next_chunk;
            sink->at = sink->queue->chunks[sink->chunk].bytes;
            sink->room_bytes = RESONATOR_CHUNK_BYTES;
        }
        uint32_t piece = size < sink->room_bytes ? size : sink->room_bytes;
        for (uint32_t i = 0; i < piece; i++) {
            *sink->at++ = bytes[i];
        }
        sink->room_bytes -= piece;
        bytes += piece;
        size -= piece;
    }
}

void resonator_store(uint8_t *bytes, uint64_t value, uint32_t size)
{
    for (uint32_t i = 0; i < size; i++) {
        bytes[i] = (uint8_t)value;
        value >>= 8;
    }
}

void resonator_put_number(struct resonator_sink *sink, uint8_t tag, uint64_t value)
{
    uint8_t field[2 + MAX_NUMBER_BYTES];
    uint32_t size = 1;
    for (uint64_t rest = value >> 8; rest != 0; rest >>= 8) {
        size++;
    }
    field[0] = tag;
    field[1] = (uint8_t)size;
    resonator_store(field + 2, value, size);
    resonator_put(sink, field, 2 + size);
}

void resonator_put_text(struct resonator_sink *sink, uint8_t tag, const char *text)
{
    const uint8_t *bytes = (const uint8_t *)text;
    uint32_t size = 0;
    while (size < MAX_TEXT_BYTES && bytes[size] != 0) {
        size++;
    }
    while (size > 0 && (bytes[size] & 0xC0) == 0x80) {
        size--; /* not within a character */
    }
    uint8_t head[2] = {tag, (uint8_t)size};
    resonator_put(sink, head, 2);
    resonator_put(sink, bytes, size);
}

uint32_t resonator_payload_bytes(resonator_payload payload, const void *what)
{
    struct resonator_sink counter;
    counter.at = NULL;
    counter.size_bytes = 0;
    payload(&counter, what);
    return counter.size_bytes;
}

static void put_packet(struct resonator_sink *sink, const struct resonator_head *head, uint32_t payload_bytes,
                       resonator_payload payload, const void *what)
{
    uint8_t bytes[RESONATOR_HEADER_BYTES];
    bytes[0] = 0xA5;
    bytes[1] = 0x5A;
    bytes[2] = RESONATOR_PROTOCOL_MAJOR;
    bytes[3] = head->type;
    resonator_store(bytes + 4, head->sequence, 4);
    resonator_store(bytes + 8, head->board_ticks, 8);
    resonator_store(bytes + 16, head->boot_id, 4);
    resonator_store(bytes + 20, payload_bytes, 2);
    resonator_store(bytes + 22, resonator_crc16(0xFFFF, bytes, 22), 2);
    sink->size_bytes = 0;
    sink->crc = 0xFFFFFFFF;
    resonator_put(sink, bytes, RESONATOR_HEADER_BYTES);
    payload(sink, what);
    resonator_store(bytes, ~sink->crc, RESONATOR_CRC_BYTES);
    resonator_put(sink, bytes, RESONATOR_CRC_BYTES);
}

uint16_t resonator_queue_packet(struct resonator_queue *queue, enum resonator_queue_kind kind,
                                const struct resonator_head *head, resonator_payload payload, const void *what)
{
    uint32_t payload_bytes = resonator_payload_bytes(payload, what);
    uint16_t first = resonator_queue_append(queue, kind, (uint16_t)(payload_bytes + RESONATOR_OVERHEAD_BYTES));
    struct resonator_sink sink;
    sink.queue = queue;
    sink.chunk = first;
    sink.at = queue->chunks[first].bytes;
    sink.room_bytes = RESONATOR_CHUNK_BYTES;
    put_packet(&sink, head, payload_bytes, payload, what);
    return first;
}

uint32_t resonator_write_packet(uint8_t *memory, uint32_t memory_bytes, const struct resonator_head *head,
                                resonator_payload payload, const void *what)
{
    struct resonator_sink sink;
    sink.queue = NULL;
    sink.chunk = RESONATOR_NO_CHUNK;
    sink.at = memory;
    sink.room_bytes = memory_bytes;
    put_packet(&sink, head, resonator_payload_bytes(payload, what), payload, what);
    return sink.size_bytes;
}

bool resonator_find_number(const uint8_t *payload, uint32_t size, uint8_t tag, uint64_t *value)
{
    bool found = false;
    uint32_t position = 0;
    while (position < size) {
        if (size - position < 2 || size - position - 2 < payload[position + 1]) {
            return false;
        }
        uint32_t value_bytes = payload[position + 1];
        if (payload[position] == tag) {
            if (value_bytes == 0 || value_bytes > MAX_NUMBER_BYTES) {
                return false;
            }
            *value = 0;
            for (uint32_t i = value_bytes; i > 0; i--) {
                *value = *value << 8 | payload[position + 1 + i];
            }
            found = true;
        }
        position += 2 + value_bytes;
    }
    return found;
}

void resonator_text_begin(struct resonator_text *text, const char *words)
{
    text->size = 0;
    resonator_text_add(text, words);
}

void resonator_text_add(struct resonator_text *text, const char *words)
{
    while (*words != 0 && text->size + 1 < RESONATOR_TEXT_BYTES) {
        text->characters[text->size++] = *words++;
    }
    text->characters[text->size] = 0;
}

void resonator_text_add_number(struct resonator_text *text, uint64_t value)
{
    /* By subtraction: a 64-bit division is a library function on small cores. */
    char digits[21];
    uint32_t count = 0;
    uint64_t power = 10000000000000000000u;
    for (uint32_t place = 20; place > 0; place--) {
        char digit = '0';
        while (value >= power) {
            value -= power;
            digit++;
        }
        if (count > 0 || digit != '0' || place == 1) {
            digits[count++] = digit;
        }
        power = 1;
        for (uint32_t i = 2; i < place; i++) {
            power *= 10u;
        }
    }
    digits[count] = 0;
    resonator_text_add(text, digits);
}

void resonator_text_add_hex(struct resonator_text *text, uint8_t value)
{
    static const char digits[] = "0123456789ABCDEF";
    char both[3] = {digits[value >> 4], digits[value & 15u], 0};
    resonator_text_add(text, both);
}
