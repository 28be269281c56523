"""Prints the force on each touched site, and contact events: forces.py [HOST [PORT [FORCES [EVENTS]]]]."""

import json
import os
import sys
import threading
from uuid import uuid4

from paho.mqtt.client import CallbackAPIVersion, Client

DEFAULTS = ["127.0.0.1", "1883", "resonator/+/forces", "resonator/+/contacts/event"]

host, port, forces_filter, events_filter = sys.argv[1:] + DEFAULTS[len(sys.argv) - 1 :]


def take_forces(client, context, message):
    if not message.payload:  # somebody's retained message was cleared
        return
    forces = json.loads(message.payload)
    for site in forces["sites"]:  # force_newton is None where it is not known; the status says why
        where = f"{message.topic} t_ns {forces['t_ns']} site {site['site']}"
        print(f"{where} {site['force_newton']} N {site['status']}\n", end="", flush=True)


def take_event(client, context, message):
    if not message.payload:
        return
    event = json.loads(message.payload)
    contact, when = event["contact"], f"{message.topic} t_ns {event['t_ns']}"
    print(f"{when} {event['event']} contact {contact['id']} site {contact['site']}\n", end="", flush=True)


def follow(topic_filter, take):
    """Receive on a connection of its own: Mosquitto drops QoS 1, too, for one that is behind with streams."""
    client = Client(CallbackAPIVersion.VERSION2, client_id=uuid4().hex)
    client.on_connect = lambda *_: client.subscribe(topic_filter, qos=1)
    client.message_callback_add(topic_filter, take)  # amqtt delivers retained messages of other topics, too
    client.connect_async(host, int(port))
    client.loop_forever(retry_first_connection=True)


def end(error):
    sys.excepthook(error.exc_type, error.exc_value, error.exc_traceback)
    os._exit(1)


threading.excepthook = end  # else only its thread would end
threading.Thread(target=follow, args=(events_filter, take_event), daemon=True).start()
follow(forces_filter, take_forces)
