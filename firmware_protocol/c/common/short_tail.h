/* Ends every burst of bytes on a USB bulk endpoint with a short packet, whatever stack and buffers are below.
 *
 * A transfer ends with a packet shorter than the endpoint's size. Where a burst fills whole packets, a zero-length packet
 * has to follow, and not every stack sends one. So the last byte is held back until all before it have left the buffer:
 * it is then a packet of its own, unless more bytes came meanwhile.
 */
#ifndef SHORT_TAIL_H
#define SHORT_TAIL_H

#include <stdbool.h>
#include <stdint.h>

struct short_tail {
    bool held; /* `byte` was accepted and is not written */
    uint8_t byte;
};

/* Write to a buffer; return how many bytes it accepted. */
typedef uint32_t (*short_tail_write)(void *context, const uint8_t *bytes, uint32_t size);

/* Accept bytes: write all but the last, which is held. Return how many were accepted. */
static inline uint32_t short_tail_put(struct short_tail *tail, const uint8_t *bytes, uint32_t size,
                                      short_tail_write write, void *context)
{
    if (size == 0) {
        return 0;
    }
    if (tail->held) {
        if (write(context, &tail->byte, 1) == 0) {
            return 0;
        }
        tail->held = false;
    }
    uint32_t written = write(context, bytes, size - 1);
    if (written < size - 1) {
        return written;
    }
    tail->byte = bytes[size - 1];
    tail->held = true;
    return size;
}

/* Write the held byte, if there is one. Call it when nothing more is to be sent and the buffer is empty. */
static inline void short_tail_release(struct short_tail *tail, short_tail_write write, void *context)
{
    if (tail->held && write(context, &tail->byte, 1) == 1) {
        tail->held = false;
    }
}

#endif
