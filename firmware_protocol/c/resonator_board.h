/* The board's side of the wire (PROTOCOL.md): bytes from the host in, answers and frames out.
 *
 * No allocation, no globals, no clock: the caller places one struct resonator_board, gives it memory for input and
 * output, passes it the ticks, and moves the bytes. All functions for one board are called from one context, or with
 * the interrupts masked that call the others; each returns soon. README.md has the order of calls.
 */
#ifndef RESONATOR_BOARD_H
#define RESONATOR_BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "resonator_packets.h"
#include "resonator_queue.h"

#define RESONATOR_CHANNELS 4
#define RESONATOR_RECORD_BYTES 44
#define RESONATOR_TONE_BYTES 12
#define RESONATOR_PART_HEAD_BYTES 8
#define RESONATOR_MAX_TONES_PER_PART 744
#define RESONATOR_MAX_TONES 46872 /* on each channel */
#define RESONATOR_MAX_SERIAL_NUMBER 63
#define RESONATOR_MIN_INPUT_BYTES 64
#define RESONATOR_VANISHED_S 10 /* after this time without a byte, a TCP host is replaced by another that connects */

enum resonator_state { RESONATOR_IDLE = 0, RESONATOR_CONFIGURED = 1, RESONATOR_RUNNING = 2 };

enum resonator_counter_kind { RESONATOR_SINGLE_TONE = 0, RESONATOR_CHANNELISED = 1 };

enum resonator_reset_cause {
    RESONATOR_RESET_UNKNOWN = 0,
    RESONATOR_RESET_POWER_ON = 1,
    RESONATOR_RESET_BROWN_OUT = 2,
    RESONATOR_RESET_WATCHDOG = 3,
    RESONATOR_RESET_SOFTWARE = 4,
    RESONATOR_RESET_PIN = 5
};

enum resonator_capability { RESONATOR_REPORTS_TEMPERATURE = 1, RESONATOR_CAN_LOCATE = 2 };

enum resonator_log_level {
    RESONATOR_LOG_DEBUG = 10,
    RESONATOR_LOG_INFO = 20,
    RESONATOR_LOG_WARNING = 30,
    RESONATOR_LOG_ERROR = 40
};

enum resonator_record_flag {
    RESONATOR_LOST_EDGE = 1,
    RESONATOR_OVERFLOW = 2,
    RESONATOR_SATURATED = 4,
    RESONATOR_CAPTURE_SWITCH = 8,
    RESONATOR_NO_SIGNAL = 16,
    RESONATOR_STRIDE_BREAK = 32
};

/* Who the board is. Texts are UTF-8, terminated by 0, cut at 255 bytes on the wire. */
struct resonator_identity {
    const char *product;
    const char *serial_number;
    const char *firmware;
    uint8_t reset_cause;
};

/* Kind and limits of the board's counter. */
struct resonator_description {
    uint8_t counter_kind;
    uint16_t tones; /* single-tone: 1 */
    uint64_t reference_millihertz;
    uint64_t gate_ticks_min;
    uint64_t gate_ticks_max; /* below 2^32 */
    uint64_t gate_ticks_step; /* gates are multiples of it; at least 1 */
    const char *plate;
    uint64_t oscillator_millihertz; /* channelised only, else 0 */
    uint64_t oscillator_spacing_millihertz;
    uint64_t capabilities; /* enum resonator_capability, or-ed */
};

/* What the caller gives the board to keep for its life. */
struct resonator_memory {
    uint8_t *input; /* its size is the host's byte credit */
    uint16_t input_bytes;
    struct resonator_chunk *chunks;
    uint16_t chunk_count;
};

/* Sums over one channel's stamps in one gate; resonator_sums.h makes them from captured edges. */
struct resonator_record {
    uint32_t first_edge;
    uint32_t first_ticks;
    uint16_t stamps;
    uint16_t stride_edges;
    uint32_t span_ticks;
    uint64_t s1_ticks;
    uint64_t s2_ticks;
    uint64_t q2_ticks2;
    uint16_t attenuation_db256;
    uint16_t flags;
};

/* Which tones of which channel a part carries. */
struct resonator_block {
    uint8_t channel;
    uint16_t first_tone;
    uint16_t tones;
    uint8_t part;
    uint8_t parts;
};

/* Receives what the decoder found in the host's bytes; for tests and traces. Either member may be NULL. */
struct resonator_watcher {
    void *context;
    void (*packet)(void *context, const struct resonator_packet *packet);
    void (*damage)(void *context, enum resonator_defect defect, uint64_t size_bytes);
};

/* What went lost on the way out, since boot. */
struct resonator_output_counts {
    uint64_t frames_dropped; /* for lack of room or of a host, skipped, or cut off by the end of a connection */
    uint64_t parts_dropped;  /* of frames whose first part had gone out */
    uint64_t answers_dropped;
    uint64_t logs_dropped;
};

/* Read `state`, `gate_ticks`, `started`, `located` and the counts; write nothing. */
struct resonator_board {
    enum resonator_state state;
    uint64_t gate_ticks; /* as configured; 0 while idle */
    uint32_t started;    /* runs begun: a new value means a new run, whose first gate opens now */
    uint32_t located;    /* LOCATE requests: a new value means that the board makes itself seen */
    struct resonator_output_counts output_counts;
    struct resonator_decoder decoder;

    const struct resonator_identity *identity;
    const struct resonator_description *description;
    const char *fault;
    const struct resonator_watcher *watcher;
    uint32_t boot_id;
    uint64_t ticks; /* the latest that the caller passed */
    struct resonator_queue queue;

    uint32_t frame_sequence;
    bool connected;          /* over TCP: a host that resonator_host_connects accepted */
    uint64_t received_ticks; /* when its last bytes came, or it connected */
    uint32_t run_dropped; /* of this run, each numbered before every frame in the queue */
    uint32_t run_skipped; /* of this run, up to the next frame made */
    uint32_t run_reported; /* in the last STATUS of this run */
    bool asked; /* this host has sent a request: frames, STATUS and LOG may go out */
    uint16_t open_frame;  /* first chunk of the frame whose parts are being queued, or RESONATOR_NO_CHUNK */
    bool status_due;
    uint32_t notice_sequence;
    bool temperature_known;
    uint32_t temperature_millikelvin;
    uint8_t status_bytes;
    uint8_t status_read_bytes;
    uint8_t status[64];
};

/* Makes a board idle with empty queues. `identity` and `description` are kept by reference.
   False, and the board must not be used: boot_id 0, fewer than RESONATOR_MIN_INPUT_BYTES or more than
   RESONATOR_MAX_PACKET_BYTES of input, more than 65534 chunks or too few for the longest packet of this board
   (a frame, a full part of one, IDENTITY or DESCRIPTION), gate_ticks_step 0, gate_ticks_max of 2^32 or more, too many
   tones, a serial number with other characters than PROTOCOL.md permits. */
bool resonator_init(struct resonator_board *board, const struct resonator_identity *identity,
                    const struct resonator_description *description, uint32_t boot_id,
                    const struct resonator_memory *memory);

/* A host begins afresh (USB request BEGIN): the board is idle, its output is emptied, a begun packet is discarded.
   Stop a transfer that reads from resonator_output first. */
void resonator_begin(struct resonator_board *board);

/* The connection to the host has ended (TCP): the output is emptied, a begun packet is discarded, a run goes on.
   Frames count as dropped until the next host has sent a request. Stop a transfer that reads from resonator_output
   first. */
void resonator_connection_ended(struct resonator_board *board);

/* Another host has connected (TCP) at `ticks`. True: serve it, and close the former connection, which has ended.
   False: the former host has connected, or sent bytes, within RESONATOR_VANISHED_S; close the new connection. */
bool resonator_host_connects(struct resonator_board *board, uint64_t ticks);

/* Processes bytes from the host, received at `ticks`; answers go to the output queue. */
void resonator_receive(struct resonator_board *board, const uint8_t *bytes, uint32_t size, uint64_t ticks);

/* Queues the frame of the gate that closed at `ticks` (single-tone). False: not running, no host has asked yet, or no
   room even after all older frames were dropped; while running the frame then counts as dropped, and its number is
   used up. */
bool resonator_frame(struct resonator_board *board, uint64_t ticks,
                     const struct resonator_record records[RESONATOR_CHANNELS]);

/* The same for a channelised counter, part by part in order: `tones` are block->tones wire records of 12 bytes. */
bool resonator_frame_part(struct resonator_board *board, uint64_t ticks, const struct resonator_block *block,
                          const uint8_t *tones);

/* The gate closed and its frame could not be made: its number is used up and it counts as dropped. */
void resonator_frame_skipped(struct resonator_board *board);

/* Asks for a STATUS at the next packet boundary; call it at most once a second. */
void resonator_status(struct resonator_board *board);

/* The temperature that every later STATUS carries. */
void resonator_temperature(struct resonator_board *board, uint32_t millikelvin);

/* Queues a line for a person to read. False: nobody asked the board anything yet, or no room beside the frames. */
bool resonator_log(struct resonator_board *board, uint64_t ticks, enum resonator_log_level level, const char *text);

/* The board cannot count: START is refused with this text (kept by reference) until NULL is given. A run in progress
   ends: the board goes to configured, and the text goes out as a LOG of level 40, for which frames make room; it is
   dropped if no host has sent a request, or no frame is left to make room. */
void resonator_fault(struct resonator_board *board, uint64_t ticks, const char *text);

/* Bytes to send next, and how many; 0 when there are none. They stay valid until consumed. */
uint16_t resonator_output(struct resonator_board *board, const uint8_t **bytes);

/* So many of those were sent. */
void resonator_consumed(struct resonator_board *board, uint16_t size);

/* What the queue holds, as DESCRIPTION says it. */
uint32_t resonator_queue_bytes(const struct resonator_board *board);

#endif
