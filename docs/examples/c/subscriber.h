/* Receives the messages of MQTT topic filters: MQTT 5 where the broker speaks it, else 3.1.1. */
#ifndef SUBSCRIBER_H
#define SUBSCRIBER_H

#include <stddef.h>

typedef void take_message(const char *topic, const void *payload, size_t size_bytes);

/* Subscribes to each filter on a connection and in a thread of its own: Mosquitto drops messages of QoS 1, too, for a
   connection that is behind with streams. Hands over each message, across restarts of the broker; returns only where
   that can never work. The arguments are those of `main`, [HOST [PORT [TOPIC_FILTER...]]]; those given replace the
   filters, a list that NULL ends. */
int subscribe(int count, char **arguments, const char *const *topic_filters, take_message *take);

#endif
