/* Runs stm32f4/capture.c on a computer, with memory in place of its registers, by commands on standard input: for tests.
 *
 *   time COUNT                   what TIM2 counts now
 *   capture CHANNEL COUNT        a capture, and what DMA does with it
 *   over CHANNEL                 a capture that came before DMA had read the last one
 *   run GATE_TICKS               a run begins; prints the ticks
 *   gate                         capture_gate: prints what it returns, the end and four records
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "stm32f4/capture.c"

struct stm32_timer fake_tim2;
struct stm32_dma fake_dma1;
struct stm32_rcc fake_rcc;
struct stm32_gpio fake_gpioa;

static uint32_t status; /* of TIM2: a bit that is written as 0 is cleared */

static uint32_t number(void)
{
    const char *found = strtok(NULL, " \n");
    return found == NULL ? 0u : (uint32_t)strtoull(found, NULL, 10);
}

static void capture(uint32_t channel, uint32_t count)
{
    volatile uint32_t *left = &fake_dma1.streams[dma_of[channel].stream].NDTR;
    rings[channel][(RING_WORDS - *left) % RING_WORDS] = count;
    *left = *left == 1 ? RING_WORDS : *left - 1;
}

static void close_gate(void)
{
    struct resonator_record records[RESONATOR_CHANNELS];
    uint64_t end_ticks = 0;
    fake_tim2.SR = status;
    int closed = capture_gate(records, &end_ticks);
    status &= fake_tim2.SR;
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
    while (fgets(line, sizeof line, stdin) != NULL) {
        const char *command = strtok(line, " \n");
        if (strcmp(command, "time") == 0) {
            fake_tim2.CNT = number();
        } else if (strcmp(command, "capture") == 0) {
            uint32_t channel = number();
            capture(channel, number());
        } else if (strcmp(command, "over") == 0) {
            status |= (uint32_t)TIM_SR_CC1OF << number();
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
