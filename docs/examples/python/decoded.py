"""Prints net force and peak traction of every decoded frame: decoded.py [HOST [PORT [TOPIC_FILTER]]]."""

import sys

import cbor2
import numpy as np
from paho.mqtt.client import CallbackAPIVersion, Client

host, port, topic_filter = sys.argv[1:] + ["127.0.0.1", "1883", "resonator/+/decoded"][len(sys.argv) - 1 :]


def to_array(tag):
    """RFC 8746: tag 40 of [shape, tag 85 of little-endian float32]."""
    shape, numbers = tag.value
    return np.frombuffer(numbers.value, "<f4").reshape(shape)


def take(client, context, message):
    if not message.payload:  # somebody's retained message was cleared
        return
    decoded = cbor2.loads(message.payload)
    traction = to_array(decoded["traction_pascal"])  # components x, y, z, each (ny, nx) or, scattered, (m,)
    said, grid = f"{message.topic} seq {decoded['seq']}", decoded["grid"]
    if np.isnan(traction[2]).all():
        print(said, "nothing known", flush=True)
        return
    point = int(np.nanargmax(traction[2]))
    said += f" peak {traction[2].flat[point]:.6g} Pa at"
    if grid is None:  # scattered: these are the sites, in the order of `info`
        print(said, "point", point, flush=True)
        return
    row, column = divmod(point, traction.shape[2])
    x_m, y_m = grid["origin_m"] + np.array([column, row]) * grid["pitch_m"]
    x, y, z = traction.sum(axis=(1, 2), dtype=float) * grid["pitch_m"] ** 2
    print(said, f"{x_m:.6g} {y_m:.6g} m, net force {x:.6g} {y:.6g} {z:.6g} N", flush=True)


client = Client(CallbackAPIVersion.VERSION2)
client.on_connect = lambda *_: client.subscribe(topic_filter)
client.message_callback_add(topic_filter, take)  # amqtt delivers retained messages of other topics, too
client.connect_async(host, int(port))
client.loop_forever(retry_first_connection=True)
