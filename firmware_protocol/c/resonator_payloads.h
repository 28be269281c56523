/* Inside of the board: the payload of each message it sends. */
#ifndef RESONATOR_PAYLOADS_H
#define RESONATOR_PAYLOADS_H

#include "resonator_board.h"
#include "resonator_messages.h"

enum resonator_refusal_code {
    RESONATOR_REFUSED_MALFORMED = 1,
    RESONATOR_REFUSED_UNKNOWN_MESSAGE = 2,
    RESONATOR_REFUSED_NOT_IN_THIS_STATE = 3,
    RESONATOR_REFUSED_OUT_OF_RANGE = 4,
    RESONATOR_REFUSED_FAULT = 5,
    RESONATOR_REFUSED_OTHER_VERSION = 6
};

struct resonator_refusal {
    enum resonator_refusal_code code;
    const char *text;
};

struct resonator_log_line {
    enum resonator_log_level level;
    const char *text;
};

struct resonator_status_values {
    uint32_t frames_dropped;
    bool temperature_known;
    uint32_t temperature_millikelvin;
    uint64_t bytes_discarded;
};

struct resonator_part {
    const struct resonator_block *block;
    const uint8_t *tones;
};

/* Each is a resonator_payload; `what` points to what its comment names. */
/* nothing */
void resonator_put_nothing(struct resonator_sink *sink, const void *what);
/* struct resonator_board */
void resonator_put_identity(struct resonator_sink *sink, const void *what);
/* struct resonator_board */
void resonator_put_description(struct resonator_sink *sink, const void *what);
/* uint64_t: gate_ticks */
void resonator_put_configuration(struct resonator_sink *sink, const void *what);
/* struct resonator_packet: the request */
void resonator_put_payload_again(struct resonator_sink *sink, const void *what);
/* struct resonator_refusal */
void resonator_put_refusal(struct resonator_sink *sink, const void *what);
/* struct resonator_log_line */
void resonator_put_log(struct resonator_sink *sink, const void *what);
/* struct resonator_status_values */
void resonator_put_status(struct resonator_sink *sink, const void *what);
/* struct resonator_record[RESONATOR_CHANNELS] */
void resonator_put_records(struct resonator_sink *sink, const void *what);
/* struct resonator_part */
void resonator_put_part(struct resonator_sink *sink, const void *what);

#endif
