"""Sends a command to a daemon and prints its answer; the exit code is 0 if it was done."""

import argparse
import asyncio
import json
import secrets
import sys

import aiomqtt

ANSWER_S = 10

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("name", help="of the plate")
parser.add_argument("verb", help="ping, tare, ...")
parser.add_argument("request", nargs="?", type=json.loads, default={}, help="JSON object (default: {})")
parser.add_argument("--host", default="127.0.0.1")
parser.add_argument("--port", type=int, default=1883)
parser.add_argument("--prefix", default="resonator")
options = parser.parse_args()


async def main():
    """Return the answer that has the `id` of the request; others may send commands at the same time."""
    base = f"{options.prefix}/{options.name}"
    request = {"id": secrets.token_hex(8), **options.request}
    async with aiomqtt.Client(options.host, options.port) as client, asyncio.timeout(ANSWER_S):
        await client.subscribe(f"{base}/rsp/{options.verb}", qos=1)
        await client.publish(f"{base}/cmd/{options.verb}", json.dumps(request), qos=1)
        answers = (json.loads(message.payload) async for message in client.messages)
        return await anext(answer async for answer in answers if answer["id"] == request["id"])


try:
    answer = asyncio.run(main())
except TimeoutError:
    sys.exit(f"no answer from {options.name} within {ANSWER_S} s; is its daemon running?")
except aiomqtt.MqttError as error:
    sys.exit(f"broker {options.host}:{options.port}: {error}")
print(json.dumps(answer))
sys.exit(0 if answer["ok"] else 1)
