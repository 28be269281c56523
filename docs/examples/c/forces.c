/* Prints the force on each touched site of every plate: forces [HOST [PORT [TOPIC_FILTER]]] */
#include "subscriber.h"

#include <cjson/cJSON.h>
#include <math.h>
#include <stdio.h>

static const char *words(const cJSON *object, const char *key)
{
    const char *value = cJSON_GetStringValue(cJSON_GetObjectItem(object, key));
    return value ? value : "unknown";
}

static double number(const cJSON *object, const char *key)
{
    const cJSON *item = cJSON_GetObjectItem(object, key);
    return cJSON_IsNumber(item) ? item->valuedouble : NAN; /* null where it is not known; the status says why */
}

void take(const char *topic, const void *payload, size_t size_bytes)
{
    cJSON *message = cJSON_ParseWithLength(payload, size_bytes);
    const cJSON *site = NULL;
    cJSON_ArrayForEach(site, cJSON_GetObjectItem(message, "sites"))
        printf("%s t_ns %s site %.0f %.6g N %s\n", topic, words(message, "t_ns"), number(site, "site"),
               number(site, "force_newton"), words(site, "status"));
    cJSON_Delete(message);
}

int main(int count, char **arguments)
{
    return subscribe(count, arguments, "resonator/+/forces", take);
}
