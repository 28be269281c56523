#include "typed_array.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

cbor_item_t *value_of(cbor_item_t *map, const char *key)
{
    size_t pairs = map && cbor_isa_map(map) ? cbor_map_size(map) : 0;
    for (size_t i = 0; i < pairs; i++) {
        struct cbor_pair pair = cbor_map_handle(map)[i];
        if (cbor_isa_string(pair.key) && cbor_string_is_definite(pair.key) &&
            cbor_string_length(pair.key) == strlen(key) && !memcmp(cbor_string_handle(pair.key), key, strlen(key)))
            return pair.value;
    }
    return NULL;
}

cbor_item_t *element(cbor_item_t *list, size_t index)
{
    return list && cbor_isa_array(list) && index < cbor_array_size(list) ? cbor_array_handle(list)[index] : NULL;
}

double number(const cbor_item_t *item)
{
    return item && cbor_is_float(item) ? cbor_float_get_float(item) : NAN;
}

/* What a tag is put on: borrowed, as the message keeps it. */
static cbor_item_t *inside(const cbor_item_t *item, uint64_t tag)
{
    return item && cbor_isa_tag(item) && cbor_tag_value(item) == tag ? cbor_move(cbor_tag_item(item)) : NULL;
}

struct array read_array(const cbor_item_t *item)
{
    cbor_item_t *pair = inside(item, 40), *shape = element(pair, 0), *bytes = inside(element(pair, 1), 85), *size;
    struct array none = {NULL, 0, 0, 0}, array = none;
    if (!bytes || !cbor_isa_bytestring(bytes) || !cbor_bytestring_is_definite(bytes) ||
        cbor_bytestring_length(bytes) % 4)
        return none;
    array.bytes = cbor_bytestring_handle(bytes);
    size_t left = array.count = cbor_bytestring_length(bytes) / 4;
    for (size_t i = 0; (size = element(shape, i)); left /= array.last, i++) {
        array.last = cbor_isa_uint(size) ? (size_t)cbor_get_int(size) : 0;
        array.first = i ? array.first : array.last;
        if (!array.last || left % array.last)
            return none;
    }
    return left == 1 ? array : none;
}

float float_at(const struct array *array, size_t index)
{
    const unsigned char *bytes = array->bytes + 4 * index;
    uint32_t bits = bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
