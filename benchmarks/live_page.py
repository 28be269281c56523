"""Processor time of `resonatord view` while 0, 1 and 5 browsers follow skin32's streams at full rate.

Run it with `python benchmarks/live_page.py [SECONDS]`: each case lasts so long (default 10). A program
publishes 100 frames a second, each a map of 37 kB and its contacts, to a Mosquitto. Each browser receives at most 60 a
second. "stalled" is a browser that never reads: the other one next to it receives the same. Exit code 1 if five
browsers cost more than 5 % of a core.
"""

import asyncio
import json
import sys
import tempfile
import time
from asyncio.subprocess import PIPE, Process
from contextlib import AsyncExitStack
from pathlib import Path

import aiohttp
import aiomqtt
import psutil
from aiohttp import ClientWebSocketResponse

from resonator_daemon.config import Mqtt
from resonator_daemon.demo.processes import PYTHON, local_broker

SIZES = {"decoded": 37_200, "decoded/summary": 283, "contacts": 211}  # bytes of skin32's messages with one contact
SIGNALS_BYTES = 24_800
FRAME_RATE_HZ = 100
_LIMIT_PERCENT = 5.0
_TOPICS = sorted(SIZES)


async def publish(broker: Mqtt) -> None:
    """Publish frames until cancelled, each when it is due."""
    payloads = {path: bytes(size) for path, size in (SIZES | {"signals": SIGNALS_BYTES}).items()}
    async with aiomqtt.Client(broker.host, broker.port) as client:
        due_s = time.monotonic()
        while True:
            for path, payload in payloads.items():
                await client.publish(f"resonator/bench/{path}", payload)
            due_s += 1 / FRAME_RATE_HZ
            await asyncio.sleep(due_s - time.monotonic())


async def follow(url: str, seconds: float, topics: list[str]) -> int:
    """Return how many maps a browser receives."""
    maps = 0
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{url}ws", max_msg_size=0) as browser:
        await browser.send_str(json.dumps({"watch": {"plate": "bench", "topics": topics}}))
        try:
            async with asyncio.timeout(seconds):
                async for message in browser:
                    maps += message.type is aiohttp.WSMsgType.BINARY and message.data[1:].startswith(
                        b"live/bench/decoded\0"
                    )
        except TimeoutError:
            pass
    return maps


async def stall(url: str) -> tuple[aiohttp.ClientSession, ClientWebSocketResponse]:
    """Connect a browser that never reads: aiohttp stops receiving after 64 kB that are not read."""
    session = aiohttp.ClientSession()
    browser = await session.ws_connect(f"{url}ws", max_msg_size=0)
    await browser.send_str(json.dumps({"watch": {"plate": "bench", "topics": _TOPICS}}))
    return session, browser


async def measure(process: Process, url: str, browsers: int, seconds: float, topics: list[str]) -> tuple[float, float]:
    """Return the share of a core in percent, and the maps a second that each browser received."""
    view = psutil.Process(process.pid)
    followers = [asyncio.create_task(follow(url, seconds + 2.0, topics)) for _ in range(browsers)]
    await asyncio.sleep(1.0)
    before, begun_s = view.cpu_times(), time.monotonic()
    await asyncio.sleep(seconds)
    after, took_s = view.cpu_times(), time.monotonic() - begun_s
    maps = await asyncio.gather(*followers)
    busy_s = after.user + after.system - before.user - before.system
    return 100.0 * busy_s / took_s, sum(maps) / max(browsers, 1) / (seconds + 2.0)


async def run(seconds: float) -> int:
    async with AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        broker = await stack.enter_async_context(local_broker(folder))
        command = (*PYTHON, "resonator_daemon", "view", "--url", broker.url, "--listen", "127.0.0.1:0", "--json")
        view = await asyncio.create_subprocess_exec(*command, stdout=PIPE)
        stack.push_async_callback(view.wait)
        stack.callback(view.terminate)
        if view.stdout is None:
            raise RuntimeError("no pipe")
        url = json.loads(await view.stdout.readline())["url"]
        publishing = asyncio.create_task(publish(Mqtt(url=broker.url)))
        stack.callback(publishing.cancel)
        print(f"{'browsers':>10} {'streams':>22} {'% of a core':>12} {'maps/s each':>12}")
        five = 0.0
        for browsers, topics in ((0, _TOPICS), (1, _TOPICS), (5, _TOPICS), (5, [*_TOPICS, "signals"])):
            percent, rate_hz = await measure(view, url, browsers, seconds, topics)
            five = percent if browsers == 5 and topics is _TOPICS else five
            what = "map, contacts" if topics is _TOPICS else "map, contacts, signals"
            print(f"{browsers:>10} {what:>22} {percent:>12.1f} {rate_hz:>12.1f}")
        session, _browser = await stall(url)
        percent, rate_hz = await measure(view, url, 1, seconds, _TOPICS)
        print(f"{'1, stalled':>10} {'map, contacts':>22} {percent:>12.1f} {rate_hz:>12.1f}")
        await session.close()
    return int(five > _LIMIT_PERCENT)


if __name__ == "__main__":
    sys.exit(asyncio.run(run(float(sys.argv[1]) if len(sys.argv) > 1 else 10.0)))
