#define _POSIX_C_SOURCE 200809L
#include "subscriber.h"

#include <mosquitto.h>
#include <mqtt_protocol.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

enum { KEEPALIVE_S = 5, PAUSE_S = 1, TURN_MS = 1000 };

struct session {
    const char *topic_filter;
    take_message *take;
    bool accepted; /* the broker took this connection */
};

static void on_connect(struct mosquitto *client, void *context, int refused)
{
    struct session *session = context;
    if (refused)
        return; /* the broker ends the connection, too */
    session->accepted = true;
    mosquitto_subscribe(client, NULL, session->topic_filter, 1);
}

static void on_subscribe(struct mosquitto *client, void *context, int id, int count, const int *granted)
{
    struct session *session = context;
    (void)client, (void)id;
    if (count > 0 && granted[0] >= 128)
        fprintf(stderr, "the broker denies %s\n", session->topic_filter);
}

static void on_message(struct mosquitto *client, void *context, const struct mosquitto_message *message)
{
    struct session *session = context;
    (void)client;
    session->take(message->topic, message->payload, (size_t)message->payloadlen);
}

int subscribe(int count, char **arguments, const char *topic_filter, take_message *take)
{
    const char *host = count > 1 ? arguments[1] : "127.0.0.1";
    int port = count > 2 ? atoi(arguments[2]) : 1883, version = MQTT_PROTOCOL_V5;
    struct session session = {count > 3 ? arguments[3] : topic_filter, take, false};

    setvbuf(stdout, NULL, _IOLBF, 0);
    mosquitto_lib_init();
    struct mosquitto *client = mosquitto_new(NULL, true, &session);
    if (!client)
        return EXIT_FAILURE;
    /* A broker that wants to know who asks: mosquitto_username_pw_set() and mosquitto_tls_set() belong here. */
    mosquitto_connect_callback_set(client, on_connect);
    mosquitto_subscribe_callback_set(client, on_subscribe);
    mosquitto_message_callback_set(client, on_message);
    int error = mosquitto_sub_topic_check(session.topic_filter);
    while (error != MOSQ_ERR_INVAL) {
        session.accepted = false;
        mosquitto_int_option(client, MOSQ_OPT_PROTOCOL_VERSION, version);
        error = mosquitto_connect(client, host, port, KEEPALIVE_S);
        bool reached = error == MOSQ_ERR_SUCCESS;
        while (error == MOSQ_ERR_SUCCESS)
            error = mosquitto_loop(client, TURN_MS, 1);
        fprintf(stderr, "%s:%d: %s\n", host, port, mosquitto_strerror(error));
        if (reached && !session.accepted) /* it may not know this version */
            version = version == MQTT_PROTOCOL_V5 ? MQTT_PROTOCOL_V311 : MQTT_PROTOCOL_V5;
        sleep(PAUSE_S);
    }
    fprintf(stderr, "usage: %s [HOST [PORT [TOPIC_FILTER]]]\n", arguments[0]);
    mosquitto_destroy(client);
    mosquitto_lib_cleanup();
    return EXIT_FAILURE;
}
