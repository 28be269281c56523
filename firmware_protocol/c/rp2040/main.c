/* A single-tone counter on an RP2040: requests in, frames of captured stamps out. */

#include "capture.h"
#include "hardware/clocks.h"
#include "hardware/structs/vreg_and_chip_reset.h"
#include "hardware/structs/watchdog.h"
#include "hardware/watchdog.h"
#include "link.h"
#include "pico/rand.h"
#include "pico/stdlib.h"
#include "pico/unique_id.h"
#include "resonator_board.h"

enum { INPUT_BYTES = 256, QUEUE_CHUNKS = 300 }; /* of three chunks a frame: 100 ms */
enum { LOCATE_MS = 5000, LED_PIN = 25 };

static const struct resonator_description description = {
    .counter_kind = RESONATOR_SINGLE_TONE,
    .tones = 1,
    .reference_millihertz = TICKS_HZ * 1000ull,
    .gate_ticks_min = TICKS_HZ / 1000,
    .gate_ticks_max = TICKS_HZ / 10,
    .gate_ticks_step = 1,
    .plate = "my-plate", /* `name` in the plate file; see the bring-up page */
    .capabilities = RESONATOR_CAN_LOCATE,
};

static char serial_number[2 * PICO_UNIQUE_BOARD_ID_SIZE_BYTES + 1];

static struct resonator_identity identity = {
    .product = "resonator-rp2040",
    .serial_number = serial_number,
    .firmware = "1.0",
};

static uint8_t input[INPUT_BYTES];
static struct resonator_chunk chunks[QUEUE_CHUNKS];
static struct resonator_board board;

static uint8_t reset_cause(void)
{
    uint32_t chip = vreg_and_chip_reset_hw->chip_reset;
    if (watchdog_hw->reason & WATCHDOG_REASON_TIMER_BITS)
        return RESONATOR_RESET_WATCHDOG;
    if (watchdog_hw->reason & WATCHDOG_REASON_FORCE_BITS)
        return RESONATOR_RESET_SOFTWARE;
    if (chip & VREG_AND_CHIP_RESET_CHIP_RESET_HAD_RUN_BITS)
        return RESONATOR_RESET_PIN;
    if (chip & VREG_AND_CHIP_RESET_CHIP_RESET_HAD_POR_BITS)
        return RESONATOR_RESET_POWER_ON; /* a brown-out sets the same bit */
    return RESONATOR_RESET_UNKNOWN;
}

static uint32_t boot_id(void)
{
    uint32_t drawn;
    do
        drawn = get_rand_32();
    while (drawn == 0);
    return drawn;
}

static void receive(void)
{
    uint8_t bytes[64];
    uint32_t started = board.started;
    uint32_t count = link_read(bytes, sizeof bytes);
    if (count > 0)
        resonator_receive(&board, bytes, count, capture_ticks());
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
    const uint8_t *bytes;
    uint16_t waiting;
    while ((waiting = resonator_output(&board, &bytes)) > 0) {
        uint32_t sent = link_write(bytes, waiting);
        resonator_consumed(&board, (uint16_t)sent);
        if (sent < waiting)
            return;
    }
    link_flush();
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
    gpio_put(LED_PIN, now_ticks < until_ticks && now_ticks / (TICKS_HZ / 10) % 2 == 0);
}

int main(void)
{
    static const struct resonator_memory memory = {input, sizeof input, chunks, QUEUE_CHUNKS};
    set_sys_clock_khz(2 * TICKS_HZ / 1000, true);
    gpio_init(LED_PIN);
    gpio_set_dir(LED_PIN, GPIO_OUT);
    pico_get_unique_board_id_string(serial_number, sizeof serial_number);
    identity.reset_cause = reset_cause();
    capture_begin();
    if (!resonator_init(&board, &identity, &description, boot_id(), &memory))
        watchdog_reboot(0, 0, 0);
    link_begin(serial_number);
    for (;;) {
        if (link_task())
            resonator_begin(&board);
        receive();
        close_gate();
        send();
        show_where();
    }
}
