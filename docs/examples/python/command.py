"""Sends a command to a daemon and prints its answer; the exit code tells whether it was done."""

import argparse
import asyncio
import json
import secrets
import sys

import aiomqtt
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

ANSWER_S = 10

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("name", help="of the plate")
parser.add_argument("verb", help="ping, tare, ...")
parser.add_argument("payload", nargs="?", default="{}", help="JSON (default: {})")
parser.add_argument("--host", default="127.0.0.1")
parser.add_argument("--port", type=int, default=1883)
parser.add_argument("--prefix", default="resonator")
options = parser.parse_args()


async def ask(version):
    """Return the answer; with MQTT 5 on a topic of this program's own, known by its number, else on `rsp/<verb>`."""
    base = f"{options.prefix}/{options.name}"
    answers, number, asked = f"{base}/rsp/{options.verb}", secrets.token_hex(8), None
    if version is aiomqtt.ProtocolVersion.V5:
        answers += f"/{number}"
        asked = Properties(PacketTypes.PUBLISH)
        asked.ResponseTopic, asked.CorrelationData = answers, number.encode()
    async with aiomqtt.Client(options.host, options.port, protocol=version) as client, asyncio.timeout(ANSWER_S):
        await client.subscribe(answers, qos=1)
        await client.publish(f"{base}/cmd/{options.verb}", options.payload, qos=1, properties=asked)
        async for message in client.messages:
            if asked is None or getattr(message.properties, "CorrelationData", None) == number.encode():
                break
        try:
            return json.loads(message.payload)
        except (ValueError, RecursionError) as error:
            sys.exit(f"the answer is no JSON: {error}")


async def main():
    try:
        return await ask(aiomqtt.ProtocolVersion.V5)
    except aiomqtt.MqttError:  # a broker that does not speak MQTT 5
        return await ask(aiomqtt.ProtocolVersion.V311)


try:
    answer = asyncio.run(main())
except TimeoutError:
    sys.exit(f"no answer from {options.name} within {ANSWER_S} s; is its daemon running?")
except aiomqtt.MqttError as error:
    sys.exit(f"broker {options.host}:{options.port}: {error}")
print(json.dumps(answer))
sys.exit(0 if answer["ok"] else 1)
