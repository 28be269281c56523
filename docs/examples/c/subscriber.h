/* Receives the messages of an MQTT topic filter: MQTT 5 where the broker speaks it, else 3.1.1. */
#ifndef SUBSCRIBER_H
#define SUBSCRIBER_H

#include <stddef.h>

typedef void take_message(const char *topic, const void *payload, size_t size_bytes);

/* Connects, subscribes, and hands over each message, across restarts of the broker; returns only where that can never
   work. The arguments are those of `main`: [HOST [PORT [TOPIC_FILTER]]]. */
int subscribe(int count, char **arguments, const char *topic_filter, take_message *take);

#endif
