/* A single-tone counter on an STM32F405 or F407: requests in, frames of captured stamps out. */

#include "capture.h"
#include "hardware.h"
#include "resonator_board.h"

enum { INPUT_BYTES = 128, QUEUE_CHUNKS = 300 }; /* of three chunks a frame: 100 ms */
enum { LOCATE_MS = 5000 };

static const struct resonator_description description = {
    .counter_kind = RESONATOR_SINGLE_TONE,
    .tones = 1,
    .reference_millihertz = TICKS_HZ * 1000ull,
    .gate_ticks_min = TICKS_HZ / 2000,
    .gate_ticks_max = TICKS_HZ / 10,
    .gate_ticks_step = 1,
    .plate = "my-plate", /* `name` in the plate file; see the bring-up page */
    .capabilities = RESONATOR_CAN_LOCATE,
};

static struct resonator_identity identity = {
    .product = "resonator-stm32f4",
    .serial_number = "0001", /* another one for each board */
    .firmware = "1.0",
};

static uint8_t input[INPUT_BYTES];
static struct resonator_chunk chunks[QUEUE_CHUNKS];
static struct resonator_board board;

static void receive(void)
{
    uint8_t bytes[32];
    uint64_t ticks;
    uint32_t started = board.started;
    size_t count = serial_read(bytes, sizeof bytes, &ticks);
    if (count > 0)
        resonator_receive(&board, bytes, (uint32_t)count, ticks);
    if (board.started != started)
        capture_run(capture_ticks(), board.gate_ticks);
}

static void close_gate(void)
{
    struct resonator_record records[RESONATOR_CHANNELS];
    uint64_t end_ticks;
    if (board.state != RESONATOR_RUNNING)
        return;
    switch (capture_gate(records, &end_ticks)) {
    case 1:
        (void)resonator_frame(&board, end_ticks, records);
        break;
    case -1:
        resonator_frame_skipped(&board);
        break;
    default:
        break;
    }
}

static void send(void)
{
    static uint16_t sending;
    const uint8_t *bytes;
    if (!serial_idle())
        return;
    resonator_consumed(&board, sending);
    sending = resonator_output(&board, &bytes);
    if (sending > 0)
        serial_send(bytes, sending);
}

static void show_where(void)
{
    static uint32_t located;
    static uint64_t until_ticks;
    uint64_t now_ticks = capture_ticks();
    if (board.located != located) {
        located = board.located;
        until_ticks = now_ticks + (uint64_t)LOCATE_MS * (TICKS_HZ / 1000);
    }
    led_set(now_ticks < until_ticks && now_ticks / (TICKS_HZ / 10) % 2 == 0);
}

int main(void)
{
    static const struct resonator_memory memory = {input, sizeof input, chunks, QUEUE_CHUNKS};
    bool crystal = hardware_begin();
    capture_begin();
    serial_begin();
    identity.reset_cause = hardware_reset_cause();
    if (!resonator_init(&board, &identity, &description, hardware_boot_id(), &memory))
        hardware_restart();
    if (!crystal) /* 16 MHz everywhere: ticks are wrong by 84 / 16, the baud rate by 42 / 16 */
        resonator_fault(&board, capture_ticks(), "the crystal does not oscillate");
    for (;;) {
        receive();
        close_gate();
        send();
        show_where();
    }
}
