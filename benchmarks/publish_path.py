"""What a message costs on its way through the publisher, beside a bare aiomqtt publish loop on the same broker.

Run it with `make bench`, or `python benchmarks/publish_path.py [SECONDS]`: each case lasts so long (default 1), the two
clients in turns, so that a busy machine slows both. Processor time is that of this process. "with encoding" makes
each payload from its message, as the daemon does; the bare loop gets ready bytes in each case. Exit code 1 where the
publisher, given ready bytes too, costs more than 1.5 times the bare loop.
"""

import asyncio
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import aiomqtt
import numpy as np

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing import event_queue, publisher
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.mqtt_messages import Outgoing
from resonator_daemon.publishing.payloads import Compensation, Decoded, Forces, Lost, Message, SiteForce
from resonator_daemon.publishing.publisher import Publisher
from resonator_daemon.publishing.topics import Topic

_ASKED = 1.5
_TURNS = 4
_START_S = 0.3
_NO_DELAY = (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
_HEADER: dict[str, Any] = {
    "seq": 1,
    "name": "left-index",
    "daemon_boot_id": "9f3c52d0",
    "board_boot_id": "51aa03c4",
    "t_ns": 1_789_000_000_000_000_000,
    "t_uncertainty_ns": 42_000,
    "lost": Lost(),
    "board_ticks": 1,
}

Send = Callable[[float], Awaitable[int]]


def forces(site_count: int) -> Forces:
    site = SiteForce(site=7, force_newton=1.234, noise_newton=0.0006, systematic_newton=0.012, status="ok")
    no_correction = Compensation(
        baseline="followed",
        common_mode=(3e-6,) * 4,
        common_mode_std=2e-7,
        plate_kelvin=0.5,
        plate_kelvin_std=0.1,
        response="off",
    )
    return Forces(
        **_HEADER,
        window_s=0.01,
        status="ok",
        reason="",
        sites=(site,) * site_count,
        beats=(),
        compensation=no_correction,
    )


def decoded() -> Decoded:
    array = np.zeros((3, 32, 32), np.float32)
    return Decoded(**_HEADER, traction_pascal=array, traction_std_pascal=array, displacement_m=array, grid=None)


@contextmanager
def mosquitto(folder: Path) -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
    config = folder / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\n")
    binary = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
    process = subprocess.Popen([binary, "-c", str(config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(_START_S)
    yield port
    process.kill()
    process.wait()


@asynccontextmanager
async def bare(port: int, payload: bytes, qos: int) -> AsyncIterator[Send]:
    async with aiomqtt.Client(
        "127.0.0.1", port, protocol=aiomqtt.ProtocolVersion.V5, socket_options=[_NO_DELAY]
    ) as client:

        async def send(seconds: float) -> int:
            count = 0
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                await client.publish("bare/stream", payload, qos)
                count += 1
            return count

        yield send


@asynccontextmanager
async def ours(port: int, message: Message, qos: int) -> AsyncIterator[Send]:
    left = Publisher(
        Mqtt(url=f"mqtt://127.0.0.1:{port}"), identifier="bench", make_will=lambda: Outgoing("bench/will", b"")
    )
    running = asyncio.create_task(left.run())
    while not left.connected:  # noqa: ASYNC110
        await asyncio.sleep(0.01)
    topic: Topic[Message] = Topic("stream", type(message), qos=1 if qos else 0)

    async def send(seconds: float) -> int:
        before = left.account.acknowledged + left.account.written
        count = 0
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            left.publish("bench", topic, message)
            count += 1
            if count % 10 == 0:
                while left._outbox.queued > 10:  # noqa: ASYNC110, SLF001  only to wait for the socket is measured, too
                    await asyncio.sleep(0)
        while left._outbox.waiting:  # noqa: ASYNC110, SLF001
            await asyncio.sleep(0)
        if left.dropped or left.account.acknowledged + left.account.written - before != count:
            raise RuntimeError(f"not all messages were sent: {left.account}")
        return count

    yield send
    await left.close()
    await running


async def measure(clients: dict[str, Send], seconds: float) -> dict[str, tuple[float, float]]:
    """Return processor time per message and messages per second, by client."""
    totals = {name: [0, 0.0, 0.0] for name in clients}
    for _ in range(_TURNS):
        for name, send in clients.items():
            cpu_s, wall_s = time.process_time(), time.monotonic()
            totals[name][0] += await send(seconds / _TURNS)
            totals[name][1] += time.process_time() - cpu_s
            totals[name][2] += time.monotonic() - wall_s
    return {name: (cpu_s / count, count / wall_s) for name, (count, cpu_s, wall_s) in totals.items()}


def _ready(payload: bytes, _message: Message) -> bytes:
    return payload


async def compare(port: int, message: Message, qos: int, seconds: float) -> float:
    """Print one case; return the publisher's cost in those of the bare loop, both without encoding."""
    payload = encode(message)

    async with bare(port, payload, qos) as loop, ours(port, message, qos) as publish:

        async def without_encoding(send_s: float) -> int:
            ready = partial(_ready, payload)
            with patch.object(publisher, "encode", ready), patch.object(event_queue, "encode", ready):
                return await publish(send_s)

        clients = {"bare aiomqtt": loop, "publisher": without_encoding, "with encoding": publish}
        figures = await measure(clients, seconds)
    bare_s = figures["bare aiomqtt"][0]
    for name, (cpu_s, rate_hz) in figures.items():
        megabytes_per_s = rate_hz * len(payload) / 1e6
        print(
            f"{len(payload) / 1e3:6.1f} kB  QoS {qos}  {name:14} {rate_hz:8.0f} messages/s {megabytes_per_s:7.1f} MB/s"
            f"  {cpu_s * 1e6:6.1f} us of processor time each, {cpu_s / bare_s:4.2f} of bare"
        )
    return figures["publisher"][0] / bare_s


async def main(seconds: float) -> int:
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder, mosquitto(Path(folder)) as port:
        for message in (forces(1), forces(12), decoded()):
            for qos in (0, 1):
                worst = max(worst, await compare(port, message, qos, seconds))
    print(f"publisher at most {worst:.2f} of the bare loop, asked: {_ASKED}")
    return 1 if worst > _ASKED else 0


if __name__ == "__main__":
    sys.exit(asyncio.run(main(float(sys.argv[1]) if len(sys.argv) > 1 else 1.0)))
