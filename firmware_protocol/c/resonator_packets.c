#include "resonator_packets.h"

#define SYNC_0 0xA5
#define SYNC_1 0x5A
#define SYNC_BYTES 2
#define CHECKED_HEADER_BYTES (RESONATOR_HEADER_BYTES - 2)

static uint32_t little_endian(const uint8_t *bytes, uint32_t size)
{
    uint32_t value = 0;
    while (size-- > 0) {
        value = value << 8 | bytes[size];
    }
    return value;
}

static void discard(struct resonator_decoder *decoder, uint32_t size, enum resonator_defect defect)
{
    if (size == 0) {
        return;
    }
    if (decoder->run_bytes == 0) {
        decoder->run_defect = defect;
    }
    decoder->run_bytes += size;
    decoder->counts.discarded += size;
}

static void accept(struct resonator_decoder *decoder, const uint8_t *at, uint32_t packet_bytes,
                   const struct resonator_decoder_handler *handler)
{
    if (decoder->run_bytes != 0) {
        handler->damage(handler->context, decoder->run_defect, decoder->run_bytes);
        decoder->run_bytes = 0;
    }
    struct resonator_packet packet;
    packet.major = at[2];
    packet.type = at[3];
    packet.sequence = little_endian(at + 4, 4);
    packet.board_ticks = (uint64_t)little_endian(at + 12, 4) << 32 | little_endian(at + 8, 4);
    packet.boot_id = little_endian(at + 16, 4);
    packet.payload_bytes = (uint16_t)(packet_bytes - RESONATOR_OVERHEAD_BYTES);
    packet.payload = at + RESONATOR_HEADER_BYTES;
    if (packet.major != RESONATOR_PROTOCOL_MAJOR) {
        decoder->counts.other_version += packet_bytes;
    } else if ((packet.type & RESONATOR_FROM_BOARD) != decoder->direction) {
        decoder->counts.echo += packet_bytes;
        return;
    } else {
        decoder->counts.accepted += packet_bytes;
    }
    handler->packet(handler->context, &packet);
}

/* Returns how many bytes at the front are settled; 0 when more must come, with needed_bytes set. */
static uint32_t settle(struct resonator_decoder *decoder, const uint8_t *at, uint32_t size,
                       const struct resonator_decoder_handler *handler)
{
    uint32_t start = 0;
    while (start < size && (at[start] != SYNC_0 || (start + 1 < size && at[start + 1] != SYNC_1))) {
        start++;
    }
    if (start > 0) {
        discard(decoder, start, RESONATOR_GARBAGE);
        return start;
    }
    if (size < RESONATOR_HEADER_BYTES) {
        /* A lone first sync byte is garbage as soon as the second is another one. */
        decoder->needed_bytes = size < SYNC_BYTES ? (uint16_t)(size + 1) : RESONATOR_HEADER_BYTES;
        return 0;
    }
    if (decoder->needed_bytes <= RESONATOR_HEADER_BYTES) {
        if (resonator_crc16(0xFFFF, at, CHECKED_HEADER_BYTES) != little_endian(at + CHECKED_HEADER_BYTES, 2)) {
            discard(decoder, SYNC_BYTES, RESONATOR_BAD_HEADER);
            return SYNC_BYTES;
        }
        uint32_t payload_bytes = little_endian(at + 20, 2);
        if (payload_bytes > (uint32_t)(decoder->capacity_bytes - RESONATOR_OVERHEAD_BYTES)) {
            discard(decoder, SYNC_BYTES, RESONATOR_BAD_LENGTH);
            return SYNC_BYTES;
        }
        decoder->needed_bytes = (uint16_t)(payload_bytes + RESONATOR_OVERHEAD_BYTES);
    }
    uint32_t packet_bytes = decoder->needed_bytes;
    if (size < packet_bytes) {
        return 0;
    }
    uint32_t crc_at = packet_bytes - RESONATOR_CRC_BYTES;
    if (~resonator_crc32(0xFFFFFFFF, at, crc_at) != little_endian(at + crc_at, RESONATOR_CRC_BYTES)) {
        discard(decoder, SYNC_BYTES, RESONATOR_BAD_CRC);
        return SYNC_BYTES;
    }
    accept(decoder, at, packet_bytes, handler);
    return packet_bytes;
}

static void search(struct resonator_decoder *decoder, const struct resonator_decoder_handler *handler)
{
    uint32_t position = 0;
    while (position < decoder->waiting_bytes) {
        uint32_t settled =
            settle(decoder, decoder->buffer + position, (uint32_t)decoder->waiting_bytes - position, handler);
        if (settled == 0) {
            break;
        }
        position += settled;
        decoder->needed_bytes = 1;
    }
    if (position > 0) {
        decoder->waiting_bytes = (uint16_t)(decoder->waiting_bytes - position);
        for (uint32_t i = 0; i < decoder->waiting_bytes; i++) {
            decoder->buffer[i] = decoder->buffer[position + i];
        }
    }
}

void resonator_decoder_init(struct resonator_decoder *decoder, uint8_t direction, uint8_t *buffer,
                            uint16_t capacity_bytes)
{
    decoder->buffer = buffer;
    decoder->capacity_bytes = capacity_bytes;
    decoder->waiting_bytes = 0;
    decoder->needed_bytes = 1;
    decoder->direction = direction;
    decoder->run_defect = RESONATOR_GARBAGE;
    decoder->run_bytes = 0;
    decoder->counts.received = 0;
    decoder->counts.accepted = 0;
    decoder->counts.other_version = 0;
    decoder->counts.echo = 0;
    decoder->counts.discarded = 0;
}

void resonator_decoder_feed(struct resonator_decoder *decoder, const uint8_t *bytes, uint32_t size,
                            const struct resonator_decoder_handler *handler)
{
    decoder->counts.received += size;
    while (size > 0) {
        /* Never 0: what waits is shorter than a packet, and a packet is no longer than the buffer. */
        uint32_t fits = (uint32_t)(decoder->capacity_bytes - decoder->waiting_bytes);
        uint32_t piece = size < fits ? size : fits;
        for (uint32_t i = 0; i < piece; i++) {
            decoder->buffer[decoder->waiting_bytes + i] = bytes[i];
        }
        decoder->waiting_bytes = (uint16_t)(decoder->waiting_bytes + piece);
        bytes += piece;
        size -= piece;
        if (decoder->waiting_bytes >= decoder->needed_bytes) {
            search(decoder, handler);
        }
    }
}

void resonator_decoder_abandon(struct resonator_decoder *decoder)
{
    discard(decoder, decoder->waiting_bytes, RESONATOR_GARBAGE);
    decoder->waiting_bytes = 0;
    decoder->needed_bytes = 1;
}
