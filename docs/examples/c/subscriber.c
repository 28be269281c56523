#define _POSIX_C_SOURCE 200809L
#include "subscriber.h"

#include <mosquitto.h>
#include <mqtt_protocol.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

enum { KEEPALIVE_S = 5, PAUSE_S = 1, TURN_MS = 1000, CONNECTIONS_MAX = 4 };

struct session {
    char id[32]; /* of the client: some brokers take only one without */
    const char *host;
    int port;
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
    bool matches = false; /* amqtt delivers retained messages of other topics, too */
    if (!mosquitto_topic_matches_sub(session->topic_filter, message->topic, &matches) && matches)
        session->take(message->topic, message->payload, (size_t)message->payloadlen);
}

/* Keeps one connection; returns where its arguments can never work. */
static void *keep_connected(void *context)
{
    struct session *session = context;
    int version = MQTT_PROTOCOL_V5, error = MOSQ_ERR_NOMEM;
    struct mosquitto *client = mosquitto_new(session->id, true, session);
    if (!client)
        return NULL;
    /* A broker that wants to know who asks: mosquitto_username_pw_set() and mosquitto_tls_set() belong here. */
    mosquitto_connect_callback_set(client, on_connect);
    mosquitto_subscribe_callback_set(client, on_subscribe);
    mosquitto_message_callback_set(client, on_message);
    while (error != MOSQ_ERR_INVAL) {
        session->accepted = false;
        mosquitto_int_option(client, MOSQ_OPT_PROTOCOL_VERSION, version);
        error = mosquitto_connect(client, session->host, session->port, KEEPALIVE_S);
        bool reached = error == MOSQ_ERR_SUCCESS;
        while (error == MOSQ_ERR_SUCCESS)
            error = mosquitto_loop(client, TURN_MS, 1);
        fprintf(stderr, "%s:%d: %s\n", session->host, session->port, mosquitto_strerror(error));
        if (reached && !session->accepted) /* it may not know this version */
            version = version == MQTT_PROTOCOL_V5 ? MQTT_PROTOCOL_V311 : MQTT_PROTOCOL_V5;
        sleep(PAUSE_S);
    }
    mosquitto_destroy(client);
    return NULL;
}

int subscribe(int count, char **arguments, const char *const *topic_filters, take_message *take)
{
    struct session sessions[CONNECTIONS_MAX];
    pthread_t threads[CONNECTIONS_MAX];
    struct timespec now;
    int connections = 0, started = 0;

    setvbuf(stdout, NULL, _IOLBF, 0);
    mosquitto_lib_init();
    clock_gettime(CLOCK_REALTIME, &now);
    for (; connections < CONNECTIONS_MAX && topic_filters[connections]; connections++) {
        struct session *session = &sessions[connections];
        *session = (struct session){.host = count > 1 ? arguments[1] : "127.0.0.1",
                                    .port = count > 2 ? atoi(arguments[2]) : 1883,
                                    .topic_filter = topic_filters[connections],
                                    .take = take};
        if (count > 3 + connections)
            session->topic_filter = arguments[3 + connections];
        snprintf(session->id, sizeof session->id, "%x-%x-%d", (unsigned)getpid(), (unsigned)now.tv_nsec, connections);
        if (mosquitto_sub_topic_check(session->topic_filter))
            break;
    }
    if (!topic_filters[connections]) /* all are right */
        while (started < connections && !pthread_create(&threads[started], NULL, keep_connected, &sessions[started]))
            started++;
    for (int i = 0; i < started; i++)
        pthread_join(threads[i], NULL);
    fprintf(stderr, "usage: %s [HOST [PORT [TOPIC_FILTER...]]]\n", arguments[0]);
    mosquitto_lib_cleanup();
    return EXIT_FAILURE;
}
