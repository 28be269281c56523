/* Prints the force on each touched site of every plate, and contact events: forces [HOST [PORT [FORCES [EVENTS]]]] */
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
    const cJSON *contact = cJSON_GetObjectItem(message, "contact"), *site = NULL;
    if (contact)
        printf("%s t_ns %s %s contact %.0f site %.0f\n", topic, words(message, "t_ns"), words(message, "event"),
               number(contact, "id"), number(contact, "site"));
    cJSON_ArrayForEach(site, cJSON_GetObjectItem(message, "sites"))
        printf("%s t_ns %s site %.0f %.6g N %s\n", topic, words(message, "t_ns"), number(site, "site"),
               number(site, "force_newton"), words(site, "status"));
    cJSON_Delete(message);
}

int main(int count, char **arguments)
{
    static const char *const topic_filters[] = {"resonator/+/forces", "resonator/+/contacts/event", NULL};
    return subscribe(count, arguments, topic_filters, take);
}
