/* Packets of the wire: checks, and a decoder that finds packets again after damage (PROTOCOL.md, section 1). */
#ifndef RESONATOR_PACKETS_H
#define RESONATOR_PACKETS_H

#include <stdbool.h>
#include <stdint.h>

#define RESONATOR_PROTOCOL_MAJOR 1
#define RESONATOR_PROTOCOL_MINOR 0

#define RESONATOR_HEADER_BYTES 24
#define RESONATOR_CRC_BYTES 4
#define RESONATOR_OVERHEAD_BYTES (RESONATOR_HEADER_BYTES + RESONATOR_CRC_BYTES)
#define RESONATOR_MAX_PAYLOAD_BYTES 8944
#define RESONATOR_MAX_PACKET_BYTES (RESONATOR_MAX_PAYLOAD_BYTES + RESONATOR_OVERHEAD_BYTES)

#define RESONATOR_FROM_BOARD 0x80 /* set in the type of everything a board sends */

/* Checks over any number of pieces: begin with the initial value, feed piece after piece.
   CRC-16: initial 0xFFFF, the result is the check. CRC-32: initial 0xFFFFFFFF, the check is the result's complement.
   A board with a CRC unit links its own versions instead of resonator_crc.c. */
uint16_t resonator_crc16(uint16_t crc, const uint8_t *bytes, uint32_t size);
uint32_t resonator_crc32(uint32_t crc, const uint8_t *bytes, uint32_t size);

/* Why a run of bytes was discarded; a run keeps its first defect. */
enum resonator_defect {
    RESONATOR_GARBAGE, /* no sync word where a packet had to begin */
    RESONATOR_BAD_HEADER,
    RESONATOR_BAD_LENGTH,
    RESONATOR_BAD_CRC
};

/* Where the bytes went: received is the sum of the others and of those that wait. */
struct resonator_byte_counts {
    uint64_t received;
    uint64_t accepted;
    uint64_t other_version;
    uint64_t echo;
    uint64_t discarded;
};

/* One packet that passed both checks; the payload stays valid until the handler returns. */
struct resonator_packet {
    uint8_t major;
    uint8_t type;
    uint16_t payload_bytes;
    uint32_t sequence;
    uint64_t board_ticks;
    uint32_t boot_id;
    const uint8_t *payload;
};

/* Receives what was found, in the order of the bytes. */
struct resonator_decoder_handler {
    void *context;
    /* A sound packet of this major version, or of another one (look at major; do not read its payload). */
    void (*packet)(void *context, const struct resonator_packet *packet);
    /* A run of discarded bytes, reported before the packet that ended it. */
    void (*damage)(void *context, enum resonator_defect defect, uint64_t size_bytes);
};

struct resonator_decoder {
    uint8_t *buffer;
    uint16_t capacity_bytes; /* also the longest packet: a longer one is a bad length */
    uint16_t waiting_bytes;
    uint16_t needed_bytes; /* nothing to decide before so many wait */
    uint8_t direction;     /* bit 7 of the types this end accepts */
    enum resonator_defect run_defect;
    uint64_t run_bytes; /* discarded and not reported yet; 0: no run is open */
    struct resonator_byte_counts counts;
};

/* direction: 0 at a board, RESONATOR_FROM_BOARD at a host. The buffer has 28 to RESONATOR_MAX_PACKET_BYTES bytes. */
void resonator_decoder_init(struct resonator_decoder *decoder, uint8_t direction, uint8_t *buffer,
                            uint16_t capacity_bytes);

/* Decodes received bytes, cut anywhere. */
void resonator_decoder_feed(struct resonator_decoder *decoder, const uint8_t *bytes, uint32_t size,
                            const struct resonator_decoder_handler *handler);

/* Discards the bytes of a packet that has begun. */
void resonator_decoder_abandon(struct resonator_decoder *decoder);

#endif
