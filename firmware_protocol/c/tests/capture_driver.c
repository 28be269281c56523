/* Runs the files of common/ by commands, one a line on standard input, and prints what comes of them: for tests.
 *
 *   extended WRAPS PENDING COUNT BITS             prints tick_clock_extended
 *   captured WRAPS PENDING COUNT BITS CAPTURE    prints the ticks of a capture close to that reading
 *   clock BITS COUNT                              begins a clock
 *   update COUNT | at COUNT                       prints the ticks
 *   begin START GATE STRIDE                       begins a run
 *   add CHANNEL TICKS                             prints 1 or 0
 *   lost CHANNEL | skip
 *   due NOW LAG                                   prints 1 or 0
 *   close                                         prints the end, and four records
 *   ring BITS DOWN MISSED                         begins the ring
 *   word INDEX WORD                               what DMA writes
 *   sort WRITTEN CHANNEL                          prints the words that were read
 *   discard WRITTEN
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "common/capture_ring.h"

static struct tick_clock clock_;
static struct gate_sorter sorter;
static struct capture_ring ring;
static volatile uint32_t words[1024];

static uint64_t number(void)
{
    const char *found = strtok(NULL, " \n");
    if (found == NULL) {
        fprintf(stderr, "capture_driver: a number is missing\n");
        exit(2);
    }
    return strtoull(found, NULL, 10);
}

static void print_records(void)
{
    struct resonator_record records[RESONATOR_CHANNELS];
    printf("%" PRIu64, gate_sorter_close(&sorter, records));
    for (uint32_t i = 0; i < RESONATOR_CHANNELS; i++) {
        const struct resonator_record *record = &records[i];
        printf(" %" PRIu32 ",%" PRIu32 ",%u,%u,%" PRIu32 ",%" PRIu64 ",%" PRIu64 ",%" PRIu64 ",%u,%u", record->first_edge,
               record->first_ticks, record->stamps, record->stride_edges, record->span_ticks, record->s1_ticks,
               record->s2_ticks, record->q2_ticks2, record->attenuation_db256, record->flags);
    }
    printf("\n");
}

static void carry_out(const char *command)
{
    if (strcmp(command, "extended") == 0) {
        uint64_t wraps = number();
        bool pending = number() != 0;
        uint32_t count = (uint32_t)number();
        printf("%" PRIu64 "\n", tick_clock_extended(wraps, pending, count, (uint32_t)number()));
    } else if (strcmp(command, "captured") == 0) {
        uint64_t wraps = number();
        bool pending = number() != 0;
        uint32_t count = (uint32_t)number();
        uint32_t bits = (uint32_t)number();
        struct tick_clock read = {tick_clock_extended(wraps, pending, count, bits), (1u << bits) - 1u};
        printf("%" PRIu64 "\n", tick_clock_at(&read, (uint32_t)number()));
    } else if (strcmp(command, "clock") == 0) {
        uint32_t bits = (uint32_t)number();
        tick_clock_begin(&clock_, bits, (uint32_t)number());
    } else if (strcmp(command, "update") == 0) {
        printf("%" PRIu64 "\n", tick_clock_update(&clock_, (uint32_t)number()));
    } else if (strcmp(command, "at") == 0) {
        printf("%" PRIu64 "\n", tick_clock_at(&clock_, (uint32_t)number()));
    } else if (strcmp(command, "begin") == 0) {
        uint64_t start_ticks = number();
        uint64_t gate_ticks = number();
        gate_sorter_begin(&sorter, start_ticks, gate_ticks, (uint16_t)number());
    } else if (strcmp(command, "add") == 0) {
        uint32_t channel = (uint32_t)number();
        printf("%d\n", gate_sorter_add(&sorter, channel, number()));
    } else if (strcmp(command, "lost") == 0) {
        gate_sorter_lost(&sorter, (uint32_t)number());
    } else if (strcmp(command, "skip") == 0) {
        gate_sorter_skip(&sorter);
    } else if (strcmp(command, "due") == 0) {
        uint64_t now_ticks = number();
        printf("%d\n", gate_sorter_due(&sorter, now_ticks, number()));
    } else if (strcmp(command, "close") == 0) {
        print_records();
    } else if (strcmp(command, "ring") == 0) {
        capture_ring_begin(&ring, words, (uint32_t)number());
        ring.down = number() != 0;
        ring.missed_ticks = (uint32_t)number();
    } else if (strcmp(command, "word") == 0) {
        uint64_t index = number();
        words[index & ((1u << ring.bits) - 1u)] = (uint32_t)number();
    } else if (strcmp(command, "sort") == 0) {
        uint64_t written = number();
        capture_ring_sort(&ring, written, &clock_, &sorter, (uint32_t)number());
        printf("%" PRIu64 "\n", ring.read);
    } else if (strcmp(command, "discard") == 0) {
        capture_ring_discard(&ring, number());
    } else {
        fprintf(stderr, "capture_driver: unknown command %s\n", command);
        exit(2);
    }
}

int main(void)
{
    static char line[256];
    while (fgets(line, sizeof line, stdin) != NULL) {
        carry_out(strtok(line, " \n"));
    }
    return 0;
}
