"""Subscriber of one plate, independent of the daemon: writes what it receives to a file, one JSON object a line.

It connects as mqtt.js does: MQTT 3.1.1, clean session, keep-alive 60 s, the next attempt 1 s after a connection ended.
Events (QoS 1) and streams (QoS 0) have connections of their own.
"""

import argparse
import asyncio
import json
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

import aiomqtt

_RETRY_S = 1.0
_ANSWER_S = 3.0
_ATTEMPTS = 4


class NoAnswerError(Exception):
    """No daemon answered with stored events."""


async def ask_events(port: int, base: str, boot_id: str | None, after_seq: int) -> dict[str, Any]:
    """Return the answer to the command `events`.

    Raises
    ------
    NoAnswerError
        No answer in several attempts, or refusals alone.
    """
    refusal: Any = "no answer"
    for attempt in range(_ATTEMPTS):
        request = {"id": f"{after_seq}-{attempt}", "after_seq": after_seq}
        if boot_id is not None:
            request["daemon_boot_id"] = boot_id
        with suppress(TimeoutError, aiomqtt.MqttError):
            async with asyncio.timeout(_ANSWER_S), aiomqtt.Client("127.0.0.1", port) as client:
                await client.subscribe(f"{base}/rsp/events", qos=1)
                await client.publish(f"{base}/cmd/events", json.dumps(request), qos=1)
                async for message in client.messages:
                    answer: dict[str, Any] = json.loads(bytes(message.payload))
                    if answer["ok"] and answer["id"] == request["id"]:
                        return answer
                    refusal = answer
    raise NoAnswerError(f"events of {boot_id} after {after_seq}: {refusal}")


async def _follow(port: int, base: str, path: str, qos: int, out: TextIO) -> None:
    runs: set[str] = set()
    while True:
        with suppress(aiomqtt.MqttError):
            async with aiomqtt.Client("127.0.0.1", port, keepalive=60) as client:
                await client.subscribe(f"{base}/{path}", qos=qos)
                async for message in client.messages:
                    received = json.loads(bytes(message.payload))
                    run = received["daemon_boot_id"]
                    if path == "contacts/event" or run not in runs:  # of the streams, when a run begins to measure
                        print(json.dumps({"path": path, "message": received}), file=out, flush=True)
                    runs.add(run)
        await asyncio.sleep(_RETRY_S)


async def _record(port: int, base: str, path: Path) -> None:
    with path.open("a") as out:
        streams = [_follow(port, base, stream, 0, out) for stream in ("forces", "contacts")]
        await asyncio.gather(_follow(port, base, "contacts/event", 1, out), *streams)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("port", type=int)
    parser.add_argument("base", help="prefix/name of the plate")
    parser.add_argument("file", type=Path)
    options = parser.parse_args()
    asyncio.run(_record(options.port, options.base, options.file))


if __name__ == "__main__":
    main()
