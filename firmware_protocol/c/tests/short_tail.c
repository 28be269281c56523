/* Bursts through a buffer of 256 bytes that a USB stack empties in packets of up to 64 at random moments; the stack
   sends no empty packet. Exit code 0 if each burst ended with a short packet and no byte changed its place. */
#include <stdio.h>
#include <stdlib.h>
#include "common/short_tail.h"

static uint8_t buffer[256], sent[1 << 20];
static uint32_t waiting, sent_bytes, last_packet;

static uint32_t write(void *context, const uint8_t *bytes, uint32_t size)
{
    (void)context;
    uint32_t count = 0;
    while (count < size && waiting < sizeof buffer)
        buffer[waiting++] = bytes[count++];
    return count;
}

static void send_packet(void)
{
    uint32_t size = waiting < 64 ? waiting : 64;
    for (uint32_t i = 0; i < size; i++)
        sent[sent_bytes++] = buffer[i];
    for (uint32_t i = size; i < waiting; i++)
        buffer[i - size] = buffer[i];
    waiting -= size;
    if (size > 0)
        last_packet = size;
}

int main(void)
{
    static uint8_t burst[600];
    struct short_tail tail = {0};
    uint32_t total = 0, whole = 0;
    srand(3);
    for (uint32_t round = 0; round < 2000; round++) {
        uint32_t size = round % 3 == 0 ? 64u * (1u + (uint32_t)rand() % 8u) : 1u + (uint32_t)rand() % 599u, put = 0;
        for (uint32_t i = 0; i < size; i++)
            burst[i] = (uint8_t)(total + i);
        while (put < size) {
            put += short_tail_put(&tail, burst + put, size - put, write, NULL);
            if (rand() % 3 == 0)
                send_packet();
        }
        total += size;
        for (uint32_t quiet = 0; quiet < 30; quiet++) {
            if (waiting == 0)
                short_tail_release(&tail, write, NULL);
            send_packet();
        }
        whole += size % 64 == 0;
        if (sent_bytes != total || last_packet == 64)
            return 1;
    }
    for (uint32_t i = 0; i < sent_bytes; i++)
        if (sent[i] != (uint8_t)i)
            return 2;
    printf("%d\n", whole > 600);
    return 0;
}
