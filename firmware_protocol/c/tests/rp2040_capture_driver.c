/* Runs rp2040/capture.c on a computer, with memory in place of PIO, DMA and PWM, by commands on standard input: for tests.
 *
 *   time TICKS SERVED        ticks since the start; SERVED: the wrap's interrupt has run
 *   edge CHANNEL TICKS       the state machine writes a word, DMA stores it
 *   stall CHANNEL            a word is lost in the FIFO
 *   run GATE_TICKS           a run begins; prints the ticks
 *   gate                     capture_gate: prints what it returns, the end and four records
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rp2040/capture.c"

struct fake_dma fake_dma;
struct fake_pio fake_pio;
struct fake_pwm fake_pwm;

static uint64_t true_ticks;
static uint32_t claimed;
static struct {
    uint32_t fifo, osr, x, y, words;
    uint64_t started_ticks;
} machines[RESONATOR_CHANNELS];

void dma_channel_configure(uint channel, const dma_channel_config_t *config, volatile void *to, const volatile void *from,
                           uint32_t count, bool trigger)
{
    (void)config, (void)to, (void)from, (void)trigger;
    fake_dma.ch[channel].transfer_count = count;
}

int dma_claim_unused_channel(bool required)
{
    (void)required;
    return (int)claimed++;
}

void pio_sm_put(struct fake_pio *pio, uint sm, uint32_t data)
{
    (void)pio;
    machines[sm].fifo = data;
}

void pio_sm_exec(struct fake_pio *pio, uint sm, uint instruction)
{
    (void)pio;
    if (instruction == pio_encode_pull(false, false))
        machines[sm].osr = machines[sm].fifo;
    else if (instruction == pio_encode_mov(pio_x, pio_osr))
        machines[sm].x = machines[sm].osr;
    else if (instruction == pio_encode_mov(pio_y, pio_osr))
        machines[sm].y = machines[sm].osr;
}

void pio_enable_sm_mask_in_sync(struct fake_pio *pio, uint32_t mask)
{
    (void)pio, (void)mask;
    for (uint32_t sm = 0; sm < RESONATOR_CHANNELS; sm++) {
        machines[sm].words = 0;
        machines[sm].started_ticks = true_ticks;
        if (machines[sm].y != STRIDE_EDGES - 1 || machines[sm].osr != STRIDE_EDGES - 1)
            exit(3);
    }
}

uint16_t pwm_get_counter(uint slice)
{
    (void)slice;
    return (uint16_t)true_ticks;
}

static uint64_t number(void)
{
    const char *found = strtok(NULL, " \n");
    return found == NULL ? 0u : strtoull(found, NULL, 10);
}

static void advance(uint64_t ticks, bool served)
{
    for (; true_ticks >> CLOCK_BITS != ticks >> CLOCK_BITS; true_ticks += 1u << CLOCK_BITS) {
        if (fake_pwm.intr)
            count_wrap(); /* of the wrap before */
        fake_pwm.intr |= 1u << CLOCK_SLICE;
    }
    true_ticks = ticks;
    if (served && fake_pwm.intr)
        count_wrap();
}

static void edge(uint32_t channel, uint64_t ticks, bool lost)
{
    /* Up to the first word the program misses STRIDE_EDGES ticks, at each word two more than that. */
    uint64_t missed = STRIDE_EDGES + (uint64_t)machines[channel].words * (STRIDE_EDGES + 2);
    uint32_t word = machines[channel].x - (uint32_t)(ticks - machines[channel].started_ticks - missed);
    machines[channel].words++;
    if (lost) {
        fake_pio.fdebug |= 1u << channel;
        return;
    }
    uint32_t *left = &fake_dma.ch[data_channel[channel]].transfer_count;
    rings[channel][(lap_words - *left) % RING_WORDS] = word;
    *left = *left == 1 ? lap_words : *left - 1;
}

static void close_gate(void)
{
    struct resonator_record records[RESONATOR_CHANNELS];
    uint64_t end_ticks = 0;
    uint32_t stalled = fake_pio.fdebug;
    int closed = capture_gate(records, &end_ticks);
    if (stalled)
        fake_pio.fdebug = 0; /* a bit is cleared by 1 */
    printf("%d %" PRIu64, closed, end_ticks);
    for (uint32_t i = 0; closed == 1 && i < RESONATOR_CHANNELS; i++) {
        const struct resonator_record *record = &records[i];
        printf(" %" PRIu32 ",%" PRIu32 ",%u,%u,%" PRIu32 ",%" PRIu64 ",%" PRIu64 ",%" PRIu64 ",%u,%u", record->first_edge,
               record->first_ticks, record->stamps, record->stride_edges, record->span_ticks, record->s1_ticks,
               record->s2_ticks, record->q2_ticks2, record->attenuation_db256, record->flags);
    }
    printf("\n");
}

int main(void)
{
    static char line[256];
    capture_begin();
    fake_pio.fdebug = 0;
    while (fgets(line, sizeof line, stdin) != NULL) {
        const char *command = strtok(line, " \n");
        if (strcmp(command, "time") == 0) {
            uint64_t ticks = number();
            advance(ticks, number() != 0);
        } else if (strcmp(command, "edge") == 0) {
            uint32_t channel = (uint32_t)number();
            edge(channel, number(), false);
        } else if (strcmp(command, "stall") == 0) {
            edge((uint32_t)number(), true_ticks, true);
        } else if (strcmp(command, "run") == 0) {
            uint64_t now_ticks = capture_ticks();
            capture_run(now_ticks, number());
            printf("%" PRIu64 "\n", now_ticks);
        } else {
            close_gate();
        }
    }
    return 0;
}
