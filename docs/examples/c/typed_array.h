/* Reads the arrays of a CBOR message, RFC 8746: tag 40 of [shape, tag 85 of little-endian float32]. */
#ifndef TYPED_ARRAY_H
#define TYPED_ARRAY_H

#include <cbor.h>
#include <stddef.h>

struct array {
    const unsigned char *bytes; /* of the message, which has to outlive this */
    size_t count;               /* of elements, row by row; 0 where there is no such array */
    size_t first, last;         /* sizes of the first and of the last dimension */
};

/* All of these take NULL and any item, and give NULL, no elements or NaN where it is not what they look for. */
cbor_item_t *value_of(cbor_item_t *map, const char *key);
cbor_item_t *element(cbor_item_t *list, size_t index);
double number(const cbor_item_t *item);
struct array read_array(const cbor_item_t *item);

/* `index` below `count` */
float float_at(const struct array *array, size_t index);

#endif
