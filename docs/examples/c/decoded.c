/* Prints net force and peak traction of every decoded frame: decoded [HOST [PORT [TOPIC_FILTER]]] */
#include "subscriber.h"
#include "typed_array.h"

#include <math.h>
#include <stdio.h>

static void print_map(const struct array *traction, cbor_item_t *grid)
{
    size_t points = traction->count / 3, columns = traction->last, point = 0;
    double sums_pascal[3] = {0.0, 0.0, 0.0}, peak_pascal = NAN; /* while no point is known */
    for (size_t i = 0; i < traction->count; i++) {
        double pascal = float_at(traction, i);
        size_t component = i / points; /* x, y, z */
        sums_pascal[component] += pascal;
        if (component == 2 && (isnan(peak_pascal) || pascal > peak_pascal)) {
            peak_pascal = pascal;
            point = i % points;
        }
    }
    if (isnan(peak_pascal)) {
        printf("nothing known\n");
        return;
    }
    printf("peak %.6g Pa ", peak_pascal);
    if (!grid || !cbor_isa_map(grid)) { /* scattered: these are the sites, in the order of `info` */
        printf("at point %zu\n", point);
        return;
    }
    double pitch_m = number(value_of(grid, "pitch_m")), area_m2 = pitch_m * pitch_m;
    double x_m = number(element(value_of(grid, "origin_m"), 0)) + (double)(point % columns) * pitch_m;
    double y_m = number(element(value_of(grid, "origin_m"), 1)) + (double)(point / columns) * pitch_m;
    printf("at %.6g %.6g m, net force %.6g %.6g %.6g N\n", x_m, y_m, sums_pascal[0] * area_m2,
           sums_pascal[1] * area_m2, sums_pascal[2] * area_m2);
}

void take(const char *topic, const void *payload, size_t size_bytes)
{
    struct cbor_load_result result;
    cbor_item_t *message = cbor_load(payload, size_bytes, &result);
    if (!message)
        return;
    struct array traction = read_array(value_of(message, "traction_pascal"));
    cbor_item_t *seq = value_of(message, "seq");
    if (traction.first == 3 && seq && cbor_isa_uint(seq)) {
        printf("%s seq %llu ", topic, (unsigned long long)cbor_get_int(seq));
        print_map(&traction, value_of(message, "grid"));
    }
    cbor_decref(&message);
}

int main(int count, char **arguments)
{
    static const char *const topic_filters[] = {"resonator/+/decoded", NULL};
    return subscribe(count, arguments, topic_filters, take);
}
