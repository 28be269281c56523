"""What is the matter with a plate? Told from its retained states alone: python situation.py [HOST [PORT [NAME]]]."""

import asyncio
import json
import sys

import aiomqtt


def situation(states):
    """Say how it stands, from the last `daemon`, `link` and `sensor` states, as dicts by that word."""
    daemon, link, sensor = (states.get(word) for word in ("daemon", "link", "sensor"))
    if daemon is None:
        return "never started"
    if daemon["state"] == "offline":
        return "clean stop" if daemon["reason"] == "stopped" else "crash"
    if link is None or link["state"] in ("lost", "waiting"):
        return "cable out"
    if link["state"] == "stalled":
        return "board hung"
    if sensor is not None and sensor["state"] == "drifting":
        return "sensor drifting"
    if link["boots"] > 1:
        return "board rebooted"
    if daemon["connections"] > 1:
        return "broker restarted"
    return "well"


async def main(host="127.0.0.1", port="1883", name="+"):
    states = {}
    async with aiomqtt.Client(host, int(port)) as client:
        await client.subscribe(f"resonator/{name}/state/+", qos=1)
        try:
            async with asyncio.timeout(0.5):  # what is retained comes at once
                async for message in client.messages:
                    _, plate, _, word = message.topic.value.split("/")
                    states.setdefault(plate, {})[word] = json.loads(message.payload)
        except TimeoutError:
            pass
    for plate in states or [name]:
        print(plate, situation(states.get(plate, {})))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
