/* PIO 0 counts edges and ticks; a PWM slice at half the system clock is the same clock for the processor to read. */

#include "capture.h"

#include "capture.pio.h"
#include "common/capture_ring.h"
#include "hardware/dma.h"
#include "hardware/gpio.h"
#include "hardware/irq.h"
#include "hardware/pio.h"
#include "hardware/pwm.h"
#include "hardware/sync.h"

enum { CLOCK_SLICE = 7, CLOCK_BITS = 16 };
enum { RING_BITS = 10, RING_WORDS = 1 << RING_BITS }; /* 20 ms at 10 MHz */
enum { LAG_TICKS = TICKS_HZ / 100000, POLL_TICKS_MAX = TICKS_HZ / 100 };

/* DMA counts 2^31 words down; then a second channel writes this number into the first and starts it again. */
enum { LAP_BITS = 31 };
static const uint32_t lap_words = 1u << LAP_BITS;

static const uint32_t all_channels = (1u << RESONATOR_CHANNELS) - 1u;

static uint32_t rings[RESONATOR_CHANNELS][RING_WORDS] __attribute__((aligned(4 * RING_WORDS)));
static uint32_t data_channel[RESONATOR_CHANNELS], again_channel[RESONATOR_CHANNELS];
static uint32_t program_offset;
static struct capture_ring captures[RESONATOR_CHANNELS];
static struct tick_clock positions[RESONATOR_CHANNELS]; /* words that DMA has written */
static struct tick_clock clock = {(uint64_t)1 << 32, UINT32_MAX};
static struct gate_sorter sorter;
static uint64_t polled_ticks;
static uint32_t gates_missed; /* skipped, and not reported to the caller yet */
static volatile uint32_t wraps; /* of the PWM slice, 1 ms each */

static void count_wrap(void)
{
    pwm_clear_irq(CLOCK_SLICE);
    wraps++;
}

uint64_t capture_ticks(void)
{
    uint32_t interrupts = save_and_disable_interrupts();
    uint32_t count = pwm_get_counter(CLOCK_SLICE);
    bool pending = (pwm_hw->intr & 1u << CLOCK_SLICE) != 0;
    /* From here on the order does not matter. `wraps` has 32 bits: 49 days, which the clock extends. */
    uint32_t low = (uint32_t)tick_clock_extended(wraps, pending, count, CLOCK_BITS);
    restore_interrupts(interrupts);
    return tick_clock_update(&clock, low);
}

static void begin_dma(uint32_t channel)
{
    uint32_t data = data_channel[channel], again = again_channel[channel];
    dma_channel_config_t settings = dma_channel_get_default_config(again);
    channel_config_set_transfer_data_size(&settings, DMA_SIZE_32);
    channel_config_set_read_increment(&settings, false);
    channel_config_set_write_increment(&settings, false);
    dma_channel_configure(again, &settings, &dma_hw->ch[data].al1_transfer_count_trig, &lap_words, 1, false);

    settings = dma_channel_get_default_config(data);
    channel_config_set_transfer_data_size(&settings, DMA_SIZE_32);
    channel_config_set_read_increment(&settings, false);
    channel_config_set_write_increment(&settings, true);
    channel_config_set_ring(&settings, true, RING_BITS + 2);
    channel_config_set_dreq(&settings, pio_get_dreq(pio0, channel, false));
    channel_config_set_chain_to(&settings, again);
    channel_config_set_high_priority(&settings, true);
    dma_channel_configure(data, &settings, rings[channel], &pio0->rxf[channel], lap_words, true);

    capture_ring_begin(&captures[channel], rings[channel], RING_BITS);
    captures[channel].down = true;
    captures[channel].missed_ticks = STRIDE_EDGES + 2;
    tick_clock_begin(&positions[channel], LAP_BITS, 0);
}

static void load(uint32_t channel, uint32_t value, enum pio_src_dest to)
{
    pio_sm_put(pio0, channel, value);
    pio_sm_exec(pio0, channel, pio_encode_pull(false, false));
    if (to != pio_osr)
        pio_sm_exec(pio0, channel, pio_encode_mov(to, pio_osr));
}

/* (Re)start all four state machines, with counts that agree with the ticks now. */
static void begin_pio(void)
{
    pio_set_sm_mask_enabled(pio0, all_channels, false);
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++) {
        pio_sm_config settings = capture_program_get_default_config(program_offset);
        sm_config_set_jmp_pin(&settings, FIRST_PIN + channel);
        dma_channel_abort(again_channel[channel]); /* first, so that it cannot start the other one again */
        dma_channel_abort(data_channel[channel]);
        pio_sm_init(pio0, channel, program_offset + capture_offset_low, &settings);
        load(channel, STRIDE_EDGES - 1, pio_y); /* and osr keeps it, as it is loaded last below */
        begin_dma(channel);
    }
    uint32_t interrupts = save_and_disable_interrupts();
    uint32_t now = (uint32_t)capture_ticks();
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++) {
        load(channel, 0u - now - STRIDE_EDGES, pio_x); /* the ticks that are missed until the first word is made */
        load(channel, STRIDE_EDGES - 1, pio_osr);
    }
    pio_enable_sm_mask_in_sync(pio0, all_channels);
    restore_interrupts(interrupts);
    pio0->fdebug = all_channels << PIO_FDEBUG_RXSTALL_LSB;
}

static uint64_t written(uint32_t channel)
{
    uint32_t left = dma_hw->ch[data_channel[channel]].transfer_count;
    /* `positions` begins beyond one lap, the words of the ring at 0. */
    return tick_clock_update(&positions[channel], lap_words - left) - lap_words;
}

void capture_begin(void)
{
    pwm_config slice = pwm_get_default_config();
    pwm_config_set_clkdiv_int(&slice, 2);
    pwm_config_set_wrap(&slice, 0xFFFF);
    pwm_init(CLOCK_SLICE, &slice, false);
    pwm_clear_irq(CLOCK_SLICE);
    pwm_set_irq_enabled(CLOCK_SLICE, true);
    irq_set_exclusive_handler(PWM_DEFAULT_IRQ_NUM(), count_wrap);
    irq_set_enabled(PWM_DEFAULT_IRQ_NUM(), true);
    pwm_set_enabled(CLOCK_SLICE, true);

    program_offset = (uint32_t)pio_add_program(pio0, &capture_program);
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++) {
        gpio_init(FIRST_PIN + channel);
        data_channel[channel] = (uint32_t)dma_claim_unused_channel(true);
        again_channel[channel] = (uint32_t)dma_claim_unused_channel(true);
    }
    begin_pio();
    capture_run(capture_ticks(), TICKS_HZ / 1000);
}

void capture_run(uint64_t now_ticks, uint64_t gate_ticks)
{
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        capture_ring_discard(&captures[channel], written(channel));
    gate_sorter_begin(&sorter, now_ticks, gate_ticks, STRIDE_EDGES);
    polled_ticks = now_ticks;
    gates_missed = 0;
}

static void lose_all(void)
{
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        gate_sorter_lost(&sorter, channel);
}

/* First the time, then how far DMA is, then the words: each is older than what follows it. */
static uint64_t poll(void)
{
    uint64_t now_ticks = capture_ticks();
    uint64_t words[RESONATOR_CHANNELS];
    bool late = now_ticks - polled_ticks > POLL_TICKS_MAX;
    polled_ticks = now_ticks;
    if (pio0->fdebug & all_channels << PIO_FDEBUG_RXSTALL_LSB) {
        begin_pio(); /* a word was lost in a FIFO: the words behind it have other numbers than they should */
        lose_all();
    }
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        words[channel] = written(channel);
    if (late) { /* a debugger had it stopped, or flash was erased */
        for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
            capture_ring_discard(&captures[channel], words[channel]);
        for (; gate_sorter_due(&sorter, now_ticks, 0); gates_missed++)
            gate_sorter_skip(&sorter);
        lose_all();
    }
    for (uint32_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        capture_ring_sort(&captures[channel], words[channel], &clock, &sorter, channel);
    return now_ticks;
}

int capture_gate(struct resonator_record records[RESONATOR_CHANNELS], uint64_t *end_ticks)
{
    uint64_t now_ticks = poll();
    if (gates_missed > 0) {
        gates_missed--;
        return -1;
    }
    if (!gate_sorter_due(&sorter, now_ticks, LAG_TICKS))
        return 0;
    *end_ticks = gate_sorter_close(&sorter, records);
    return 1;
}
