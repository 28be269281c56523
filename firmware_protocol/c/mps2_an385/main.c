/* A whole board: requests in, frames out, once round whenever something has happened. */

#include "hardware.h"
#include "resonator_board.h"
#include "synthetic_counter.h"

enum { INPUT_BYTES = 128, QUEUE_CHUNKS = 510 }; /* of three chunks a frame: 170 ms */
enum { GATES_BEHIND_MAX = 100, LOCATE_MS = 5000 };

static const uint64_t ticks_per_ms = 1000000u;

static const struct resonator_description description = {
    .counter_kind = RESONATOR_SINGLE_TONE,
    .tones = 1,
    .reference_millihertz = 1000000000000u,
    .gate_ticks_min = 1000000u,
    .gate_ticks_max = 50000000u,
    .gate_ticks_step = TICKS_PER_COUNT,
    .plate = "quartz16",
    .capabilities = RESONATOR_CAN_LOCATE,
};

static struct resonator_identity identity = {
    .product = "MPS2-AN385",
    .serial_number = "FW-0001",
    .firmware = "1.0",
};

static uint8_t input[INPUT_BYTES];
static struct resonator_chunk chunks[QUEUE_CHUNKS];
static struct resonator_board board;
static struct synthetic_counter counter;

static void receive(void)
{
    uint8_t bytes[32];
    uint64_t ticks;
    uint32_t started = board.started;
    size_t count = uart_read(bytes, sizeof bytes, &ticks);
    if (count > 0)
        resonator_receive(&board, bytes, (uint32_t)count, ticks);
    if (board.started != started)
        synthetic_start(&counter, ticks);
}

/* Close the gate that is over, if one is. Returns whether. */
static bool close_gate(void)
{
    if (board.state != RESONATOR_RUNNING)
        return false;
    uint64_t now = hardware_ticks();
    uint64_t end = counter.ticks + board.gate_ticks;
    if (now < end)
        return false;
    if (now - end > GATES_BEHIND_MAX * board.gate_ticks) { /* the emulator, or a debugger, had it stopped */
        while (counter.ticks + board.gate_ticks <= now) {
            resonator_frame_skipped(&board);
            counter.ticks += board.gate_ticks;
        }
        synthetic_start(&counter, counter.ticks);
        return true;
    }
    struct resonator_record records[RESONATOR_CHANNELS];
    synthetic_gate(&counter, end, records);
    resonator_frame(&board, end, records);
    return true;
}

static void send(void)
{
    const uint8_t *bytes;
    size_t waiting;
    while ((waiting = resonator_output(&board, &bytes)) > 0) {
        size_t sent = uart_send(bytes, waiting);
        if (sent == 0)
            return;
        resonator_consumed(&board, (uint16_t)sent);
    }
}

static void show_where(void)
{
    static uint32_t located;
    static uint64_t until_ticks;
    uint64_t now = hardware_ticks();
    if (board.located != located) {
        located = board.located;
        until_ticks = now + LOCATE_MS * ticks_per_ms;
    }
    led_set(now < until_ticks && now / (100 * ticks_per_ms) % 2 == 0);
}

int main(void)
{
    static const uint8_t causes[] = {
        [RESTART_POWER_ON] = RESONATOR_RESET_POWER_ON,
        [RESTART_PIN] = RESONATOR_RESET_PIN,
        [RESTART_FAULT] = RESONATOR_RESET_SOFTWARE,
    };
    static const struct resonator_memory memory = {input, sizeof input, chunks, QUEUE_CHUNKS};
    struct hardware_start start = hardware_begin();
    identity.reset_cause = causes[start.cause];
    if (!resonator_init(&board, &identity, &description, start.boot_id, &memory))
        hardware_restart(RESTART_FAULT);
    for (;;) {
        receive();
        bool closed = close_gate();
        send();
        show_where();
        if (!closed)
            hardware_sleep();
    }
}
