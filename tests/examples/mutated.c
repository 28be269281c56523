/* Feeds what an example takes with mutated payloads: mutated COUNT SEED FILE... ; linked with the example, whose `main` is
   renamed. Each payload lies in memory of just its size, so that a sanitizer sees what is read beyond it. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SIZE_BYTES_MAX = 1 << 16 };

void take(const char *topic, const void *payload, size_t size_bytes);

static uint64_t state;

static size_t below(size_t limit)
{
    state ^= state << 13, state ^= state >> 7, state ^= state << 17;
    return (size_t)(state >> 11) % limit;
}

static size_t mutate(unsigned char *payload, size_t size_bytes)
{
    for (size_t changes = below(4); changes && size_bytes; changes--) {
        size_t at = below(2) ? below(size_bytes) : below(size_bytes < 64 ? size_bytes : 64);
        switch (below(4)) {
        case 0:
            payload[at] = (unsigned char)below(256);
            break;
        case 1:
            payload[at] ^= (unsigned char)(1U << below(8));
            break;
        case 2: /* cut out */
            memmove(payload + at, payload + at + 1, size_bytes - at - 1);
            size_bytes--;
            break;
        default: /* end early */
            size_bytes = at;
        }
    }
    return size_bytes;
}

int main(int count, char **arguments)
{
    static unsigned char sound[SIZE_BYTES_MAX], changed[SIZE_BYTES_MAX];
    long turns = count > 3 ? atol(arguments[1]) : 0;
    state = count > 3 ? strtoull(arguments[2], NULL, 10) * 2654435761U + 1 : 1;
    for (long turn = 0; turn < turns; turn++) {
        FILE *file = fopen(arguments[3 + turn % (count - 3)], "rb");
        size_t size_bytes = file ? fread(sound, 1, sizeof sound, file) : 0;
        if (file)
            fclose(file);
        memcpy(changed, sound, size_bytes);
        if (turn >= count - 3) /* the first of each as they are */
            size_bytes = below(16) ? mutate(changed, size_bytes) : below(size_bytes + 1);
        unsigned char *payload = malloc(size_bytes ? size_bytes : 1);
        memcpy(payload, changed, size_bytes);
        take("mutated", payload, size_bytes);
        free(payload);
    }
    return EXIT_SUCCESS;
}
