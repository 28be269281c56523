/* Tones as a table: nothing is measured here. A board of your own replaces this file by its input capture.
 *
 * A stamp is the tick in which every 100th edge falls. Stamps go on across gates, and are summed one by one, as a
 * capture interrupt or a DMA buffer would give them.
 */

#include "synthetic_counter.h"

#include <stddef.h>

#include "resonator_sums.h"

enum { STRIDE_EDGES = 100 };

/* Out of resonator_daemon/base/plates/quartz16.toml: the pilot, and site 13 with its sensitivity of -5.17e-6 per newton. */
static const uint64_t reference_millihertz = 1000000000000u;
static const uint64_t pilot_millihertz = 10010000000u;
static const uint64_t site_millihertz[RESONATOR_CHANNELS] = {9971966800u, 9971963200u, 9971935100u, 9972199700u};
enum { SHIFT_1E11_PER_MILLINEWTON = 517 };

/* The touch comes in the second half of every 4 s: 2 N, reached and left within 250 ms. */
enum { CYCLE_MS = 4000, TOUCH_MS = 2000, RAMP_MS = 250, FORCE_MILLINEWTON = 2000 };
static const uint64_t ticks_per_ms = 1000000u;

static uint32_t force_millinewton(uint32_t since_ms)
{
    uint32_t left_ms = CYCLE_MS - TOUCH_MS - since_ms;
    uint32_t from_end_ms = since_ms < left_ms ? since_ms : left_ms;
    return from_end_ms < RAMP_MS ? FORCE_MILLINEWTON / RAMP_MS * from_end_ms : FORCE_MILLINEWTON;
}

static void tune(struct synthetic_tone *tone, uint64_t millihertz)
{
    if (tone->millihertz == millihertz)
        return;
    uint64_t stride = STRIDE_EDGES * reference_millihertz;
    tone->millihertz = millihertz;
    tone->period_ticks = (uint32_t)(stride / millihertz);
    tone->period_fraction = (uint32_t)((stride % millihertz << 24) / millihertz << 8);
}

/* f = f0 / (1 - K F), with K below 0. */
static uint64_t pressed(uint64_t millihertz, uint32_t millinewton)
{
    const uint64_t unit = 1000000000u;
    return millihertz * unit / (unit + SHIFT_1E11_PER_MILLINEWTON * (uint64_t)millinewton / 100u);
}

void synthetic_start(struct synthetic_counter *counter, uint64_t ticks)
{
    counter->ticks = ticks;
    counter->broken = true;
    for (size_t channel = 0; channel < RESONATOR_CHANNELS; channel++)
        counter->tones[channel].next_ticks = ticks;
}

static void count(struct synthetic_tone *tone, uint64_t until_ticks, struct resonator_sums *sums)
{
    while (tone->next_ticks < until_ticks) {
        resonator_sums_add(sums, tone->next_edge, (uint32_t)tone->next_ticks);
        tone->next_edge += STRIDE_EDGES;
        tone->next_fraction += tone->period_fraction;
        tone->next_ticks += tone->period_ticks + (tone->next_fraction < tone->period_fraction ? 1u : 0u);
    }
}

void synthetic_gate(struct synthetic_counter *counter, uint64_t ticks, struct resonator_record records[])
{
    uint32_t cycle_ms = (uint32_t)(counter->ticks / ticks_per_ms % CYCLE_MS);
    bool touched = cycle_ms >= TOUCH_MS;
    bool switched = touched != counter->touched;
    uint16_t flags = switched || counter->broken ? RESONATOR_STRIDE_BREAK : 0;
    if (switched)
        flags |= RESONATOR_CAPTURE_SWITCH;
    for (size_t channel = 0; channel < RESONATOR_CHANNELS; channel++) {
        struct synthetic_tone *tone = &counter->tones[channel];
        struct resonator_sums sums;
        if (touched)
            tune(tone, pressed(site_millihertz[channel], force_millinewton(cycle_ms - TOUCH_MS)));
        else
            tune(tone, pilot_millihertz);
        resonator_sums_begin(&sums);
        count(tone, ticks, &sums);
        resonator_sums_record(&sums, STRIDE_EDGES, &records[channel]);
        records[channel].attenuation_db256 = 6 * 256;
        records[channel].flags = flags;
    }
    counter->ticks = ticks;
    counter->touched = touched;
    counter->broken = false;
}
