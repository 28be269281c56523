"""Print what is the matter with a plate, from its retained states alone: python situation.py [HOST [PORT [NAME]]]."""

import asyncio
import json
import sys

import aiomqtt


def situation(states):
    """Return the situation of a daemon, from the last states by topic: `daemon`, `link`, `sensor`.

    "Broker restarted" means that the daemon has connected to the broker again; the states do not show why.
    """
    if "daemon" not in states:
        return "never started"
    if states["daemon"]["state"] == "offline":
        return "clean stop" if states["daemon"]["reason_code"] == "stopped" else "crash"
    words = {part: states[part]["state"] if part in states else "unknown" for part in ("daemon", "link", "sensor")}
    match tuple(words.values()):
        case "online", "lost" | "waiting", _:
            return "cable out"
        case "online", "stalled", _:
            return "board hung"
        case "online", "online", "drifting":
            return "sensor drifting"
        case "online", "online", "online":
            pass
        case _:
            return ", ".join(f"{part} {word}" for part, word in words.items() if word != "online")
    if states["link"]["boot_count"] > 1:
        return "board rebooted"
    if states["daemon"]["connections"] > 1:
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
    if len(sys.argv) > 4 or not all(port.isdecimal() for port in sys.argv[2:3]):
        sys.exit(__doc__)
    asyncio.run(main(*sys.argv[1:]))
