/* Test of the receive ring, with an interrupt at each of its barriers. Exit code 0 if no byte was lost or read before
   it was written, and a full ring refused one. */
#include <stdio.h>
static void interrupt(void);
#define RECEIVE_RING_BARRIER() interrupt()
#include "common/receive_ring.h"

static struct receive_ring ring;
static uint32_t sent, barriers;
static int within;

static void interrupt(void)
{
    barriers++;
    if (within)
        return;
    within = 1;
    for (int more = 0; more < 3 && receive_ring_write(&ring, (uint8_t)sent, sent * 5u); more++)
        sent++;
    within = 0;
}

int main(void)
{
    uint8_t bytes[32];
    uint32_t counts = 0, seen = 0, rounds = 0;
    size_t count;
    ring.written = ring.read = 0xFFFFFF80u; /* the indices wrap */
    interrupt();
    while (rounds++ < 10000) {
        count = receive_ring_read(&ring, bytes, 1 + rounds % sizeof bytes, &counts);
        for (size_t i = 0; i < count; i++)
            if (bytes[i] != (uint8_t)seen++)
                return 1;
        if (count > 0 && counts != (seen - 1) * 5u)
            return 2;
    }
    within = 1; /* no more interrupts */
    while ((count = receive_ring_read(&ring, bytes, sizeof bytes, &counts)) > 0)
        seen += (uint32_t)count;
    printf("%d %d\n", barriers > 2 * 10000, sent > 10000);
    if (seen != sent)
        return 3;
    uint32_t fits = 0;
    while (receive_ring_write(&ring, 1, 1))
        fits++;
    return fits == RECEIVE_RING_SLOTS ? 0 : 4;
}
