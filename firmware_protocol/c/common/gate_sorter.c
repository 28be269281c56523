#include "common/gate_sorter.h"

void gate_sorter_begin(struct gate_sorter *sorter, uint64_t start_ticks, uint64_t gate_ticks, uint16_t stride_edges)
{
    sorter->start_ticks = start_ticks;
    sorter->gate_ticks = gate_ticks;
    sorter->stride_edges = stride_edges;
    sorter->first = true;
    for (uint32_t i = 0; i < RESONATOR_CHANNELS; i++) {
        struct gate_channel *channel = &sorter->channels[i];
        resonator_sums_begin(&channel->sums);
        channel->edge = 0;
        channel->flags = 0;
        channel->broken = true;
        channel->closed = false;
    }
}

bool gate_sorter_add(struct gate_sorter *sorter, uint32_t channel, uint64_t ticks)
{
    struct gate_channel *at = &sorter->channels[channel];
    if (ticks >= sorter->start_ticks + sorter->gate_ticks) {
        return false;
    }
    at->edge += sorter->stride_edges;
    if (ticks < sorter->start_ticks) {
        if (!sorter->first) {
            gate_sorter_lost(sorter, channel); /* its gate is closed: the lag was longer than was waited for */
        }
        return true;
    }
    if (!at->closed && !resonator_sums_add(&at->sums, at->edge, (uint32_t)ticks)) {
        at->flags |= RESONATOR_OVERFLOW;
        at->closed = true;
    }
    return true;
}

void gate_sorter_lost(struct gate_sorter *sorter, uint32_t channel)
{
    sorter->channels[channel].flags |= RESONATOR_LOST_EDGE;
    sorter->channels[channel].closed = true;
}

bool gate_sorter_due(const struct gate_sorter *sorter, uint64_t now_ticks, uint64_t lag_ticks)
{
    return now_ticks >= sorter->start_ticks + sorter->gate_ticks + lag_ticks;
}

/* Open the next gate; `broken`: the records of it do not continue those before, on any channel. */
static void open_next(struct gate_sorter *sorter, bool broken)
{
    sorter->start_ticks += sorter->gate_ticks;
    sorter->first = false;
    for (uint32_t i = 0; i < RESONATOR_CHANNELS; i++) {
        struct gate_channel *channel = &sorter->channels[i];
        channel->broken = broken || channel->closed || channel->sums.stamps == 0;
        channel->closed = false;
        channel->flags = 0;
        resonator_sums_begin(&channel->sums);
    }
}

uint64_t gate_sorter_close(struct gate_sorter *sorter, struct resonator_record records[RESONATOR_CHANNELS])
{
    for (uint32_t i = 0; i < RESONATOR_CHANNELS; i++) {
        const struct gate_channel *channel = &sorter->channels[i];
        resonator_sums_record(&channel->sums, sorter->stride_edges, &records[i]);
        records[i].attenuation_db256 = 0;
        records[i].flags = channel->flags;
        if (channel->sums.stamps == 0) {
            records[i].flags |= RESONATOR_NO_SIGNAL;
        }
        if (channel->broken) {
            records[i].flags |= RESONATOR_STRIDE_BREAK;
        }
    }
    open_next(sorter, false);
    return sorter->start_ticks;
}

void gate_sorter_skip(struct gate_sorter *sorter)
{
    open_next(sorter, true);
}
