"""Prints the force on each touched site of every plate: forces.py [HOST [PORT [TOPIC_FILTER]]]."""

import json
import sys

from paho.mqtt.client import CallbackAPIVersion, Client

host, port, topic_filter = sys.argv[1:] + ["127.0.0.1", "1883", "resonator/+/forces"][len(sys.argv) - 1 :]


def take(client, context, message):
    forces = json.loads(message.payload)
    for site in forces["sites"]:  # force_newton is None where it is not known; the status says why
        where = f"{message.topic} t_ns {forces['t_ns']} site {site['site']}"
        print(where, site["force_newton"], "N", site["status"], flush=True)


client = Client(CallbackAPIVersion.VERSION2)
client.on_connect = lambda *_: client.subscribe(topic_filter)
client.on_message = take
client.connect_async(host, int(port))
client.loop_forever(retry_first_connection=True)
