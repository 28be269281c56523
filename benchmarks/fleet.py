"""A fleet of skins on two bridged Mosquitto brokers: bytes, messages and processor time of each part.

Run it with `python benchmarks/fleet.py [--daemons N] [--plates N]... [--decoders N] [--seconds S] [--json]`.

Daemons publish to the near broker; a bridge carries `signals` and `info` to the far broker, and results back.
Decoders connect to the far broker and share frames (`$share`). First, real daemons with emulated boards of skin32 run;
the messages of one are stored. Then a player publishes them under `--plates` names, at the real rate, over a
connection for each: the first part measures daemons, the second one brokers and decoders without them.
Processor time of emulators, player and this process is excluded. Brokers count bytes and messages (`$SYS`).
All parts share this computer: a row is valid if the player reaches its rate.
"""

import argparse
import asyncio
import json
import shutil
import socket
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import aiomqtt

from resonator_daemon.demo.processes import PYTHON, Child, start_child, start_emulator
from resonator_daemon.plate import load_plate

PLATE = "skin32"
KEPT_S = 4.0
START_S = 60.0
SYS_S = 3.0  # the brokers' counters come each second
BRIDGE = """connection far
address 127.0.0.1:{port}
bridge_protocol_version mqttv50
try_private true
topic resonator/+/info out 1
topic resonator/+/signals out 0
topic resonator/+/decoded/# in 0
topic resonator/+/contacts in 0
"""
COUNTERS = {
    "bytes/received": "bytes_in",
    "bytes/sent": "bytes_out",
    "publish/messages/received": "messages_in",
    "publish/messages/sent": "messages_out",
    "publish/messages/dropped": "dropped",
}
Kept = list[tuple[float, str, bytes]]  # seconds, path below the plate, payload


class Watched:
    """Counters of a broker, and the health of its decoders."""

    def __init__(self) -> None:
        self.sys: dict[str, int] = {}
        self.health: dict[str, Any] = {}
        self.states: dict[str, str] = {}

    async def watch(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            topic, payload = message.topic.value, bytes(message.payload)
            if topic.startswith("$SYS"):
                name = COUNTERS.get(topic.removeprefix("$SYS/broker/"))
                if name:
                    self.sys[name] = int(payload)
            elif topic.endswith("/health"):
                self.health[topic.split("/")[2]] = json.loads(payload)
            elif payload:
                self.states[topic.split("/")[2]] = json.loads(payload)["state"]

    def decoding(self) -> Counter[str]:
        total: Counter[str] = Counter()
        for health in self.health.values():
            for plate in health["plates"].values():
                total.update({key: plate[key] for key in ("received", "decoded", "skipped", "unusable", "waiting")})
        return total


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


@asynccontextmanager
async def running(part: str, folder: Path, *command: str) -> AsyncIterator[Child]:
    child = await start_child(part, folder, command)
    try:
        yield child
    finally:
        await child.stop()


async def broker(stack: AsyncExitStack, part: str, folder: Path, bridge: str = "") -> tuple[Child, int, Watched]:
    program, port = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin"), free_port()
    if program is None:
        raise SystemExit("Mosquitto is not installed: apt-get install mosquitto")
    settings = folder / f"{part}.conf"
    settings.write_text(
        f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\npersistence false\nlog_type error\n"
        f"user root\nsys_interval 1\n{bridge}"
    )
    child = await stack.enter_async_context(running(part, folder, program, "-c", str(settings)))
    watched = Watched()
    for attempt in range(50):
        try:
            client = await stack.enter_async_context(aiomqtt.Client("127.0.0.1", port))
            break
        except aiomqtt.MqttError:
            if attempt == 49:
                raise
            await asyncio.sleep(0.1)
    for topic in ("$SYS/broker/#", "resonator/decoder/+/health", "resonator/decoder/+/state"):
        await client.subscribe(topic)
    task = asyncio.create_task(watched.watch(client))
    stack.callback(task.cancel)
    return child, port, watched


async def until(what: str, predicate: Any) -> None:
    try:
        async with asyncio.timeout(START_S):
            while not predicate():  # noqa: ASYNC110  what is waited for is in other processes
                await asyncio.sleep(0.05)
    except TimeoutError:
        raise SystemExit(f"waited {START_S:.0f} s for {what}") from None


class Fleet:
    """Two bridged brokers with decoders on the far one."""

    def __init__(self, folder: Path, stack: AsyncExitStack) -> None:
        self.folder, self.stack = folder, stack
        self.parts: dict[str, list[Child]] = {}

    async def start(self, decoders: int) -> None:
        far, far_port, self.far = await broker(self.stack, "far broker", self.folder)
        near, self.port, self.near = await broker(self.stack, "near broker", self.folder, BRIDGE.format(port=far_port))
        self.parts = {"near broker": [near], "far broker": [far], "decoders": []}
        config = self.folder / "decoder.toml"
        config.write_text(f'[mqtt]\nurl = "mqtt://127.0.0.1:{far_port}"\n[decoding]\nplates = ["+"]\ngroup = "touch"\n')
        for number in range(decoders):
            command = (*PYTHON, "resonator_daemon", "decode", "--config", str(config))
            self.parts["decoders"].append(
                await self.stack.enter_async_context(running(f"decoder {number}", self.folder, *command))
            )
        await until("the decoders", lambda: len(self.far.health) == decoders)

    async def measure(self, seconds: float) -> dict[str, float]:
        """Return rates of both brokers and the decoders, and processor time of each part in percent of a core."""
        await until("decoded frames", lambda: set(self.far.states.values()) == {"online"})
        await asyncio.sleep(SYS_S)
        before = self._counts()
        for child in (each for part in self.parts.values() for each in part):
            child.mark()
        began_s = time.monotonic()
        await asyncio.sleep(seconds)
        took_s = time.monotonic() - began_s
        cpu = {f"{name} cpu_percent": 100 * sum(c.cpu_s() for c in part) / took_s for name, part in self.parts.items()}
        after = self._counts()
        rates = {name: (after[name] - before[name]) / took_s for name in after}
        return rates | cpu

    def _counts(self) -> dict[str, int]:
        counts = {f"{name} {key}": value for name in ("near", "far") for key, value in getattr(self, name).sys.items()}
        return counts | {f"frames {key}": value for key, value in self.far.decoding().items()}


async def live(daemons: int, decoders: int, seconds: float) -> tuple[dict[str, float], Kept]:
    """Run real daemons with emulated boards; return the figures, and the messages of one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        async with AsyncExitStack() as stack:
            fleet = Fleet(folder, stack)
            await fleet.start(decoders)
            fleet.parts["daemons"] = []
            for number in range(daemons):
                emulator = await start_emulator(
                    PLATE, load_plate(PLATE), await asyncio.to_thread(part_of, folder, number)
                )
                stack.push_async_callback(emulator.child.stop)
                config = folder / f"plate-{number}.toml"
                config.write_text(
                    f'name = "plate-{number}"\nplate = "{PLATE}"\nlink = "{emulator.link}"\n'
                    f'[mqtt]\nurl = "mqtt://127.0.0.1:{fleet.port}"\n[decoding]\nexternal = true\n'
                )
                command = (*PYTHON, "resonator_daemon", "run", "--config", str(config))
                child = await stack.enter_async_context(running(f"daemon {number}", folder, *command))
                fleet.parts["daemons"].append(child)
            found = await fleet.measure(seconds)
            return found, await keep(fleet.port)


def part_of(folder: Path, number: int) -> Path:
    (inner := folder / str(number)).mkdir()
    return inner


async def keep(port: int) -> Kept:
    """Return the messages of one plate, retained ones first."""
    kept: Kept = []
    async with aiomqtt.Client("127.0.0.1", port, max_inflight_messages=0) as client:
        await client.subscribe("resonator/plate-0/#")
        began_s = time.monotonic()
        async for message in client.messages:
            now_s = time.monotonic() - began_s
            if now_s > KEPT_S:
                break
            path = message.topic.value.removeprefix("resonator/plate-0/")
            if not path.startswith(("decoded", "contacts")):  # those are the decoders'
                kept.append((0.0 if message.retain else now_s, path, bytes(message.payload)))
    return kept


def packet(topic: str, payload: bytes, retain: bool = False) -> bytes:
    """Return a PUBLISH packet of MQTT 3.1.1, QoS 0."""
    body = len(topic).to_bytes(2) + topic.encode() + payload
    length, size = len(body), bytearray()
    while True:
        length, part = divmod(length, 128)
        size.append(part | (0x80 if length else 0))
        if not length:
            return bytes([0x31 if retain else 0x30]) + bytes(size) + body


class Player(threading.Thread):
    """Publishes the messages of one plate under many names, again and again, each over a connection of its own."""

    def __init__(self, port: int, kept: Kept, plates: int) -> None:
        super().__init__(daemon=True)
        self._plates = []
        for number in range(plates):
            identifier, base = f"player-{number}".encode(), f"resonator/plate-{number}/"
            connect = b"\0\4MQTT\4\2\0\0" + len(identifier).to_bytes(2) + identifier
            link = socket.create_connection(("127.0.0.1", port))
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.sendall(bytes([0x10, len(connect)]) + connect)
            link.recv(4)
            info = next(payload for _, path, payload in kept if path == "info")
            link.sendall(packet(base + "info", info, retain=True))
            self._plates.append((link, base))
        self._stream = [each for each in kept if each[0] > 0.0]
        self._over = threading.Event()
        self.sent = self.signals = 0
        self.behind_s = 0.0

    def run(self) -> None:
        began_s, turn = time.monotonic(), 0
        while not self._over.is_set():
            for due_s, path, payload in self._stream:
                self.behind_s = time.monotonic() - began_s - turn * KEPT_S - due_s
                if self.behind_s < 0.0:
                    time.sleep(-self.behind_s)
                for link, base in self._plates:
                    link.sendall(packet(base + path, payload))
                self.sent += len(self._plates)
                self.signals += len(self._plates) * (path == "signals")
                if self._over.is_set():
                    break
            turn += 1
        for link, _ in self._plates:
            link.close()

    def stop(self) -> None:
        self._over.set()
        self.join()


async def played(kept: Kept, plates: int, decoders: int, seconds: float) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as name:
        async with AsyncExitStack() as stack:
            fleet = Fleet(Path(name), stack)
            await fleet.start(decoders)
            player = Player(fleet.port, kept, plates)
            player.start()
            try:
                await until("skins", lambda: set(fleet.far.states.values()) == {"online"})
                before, began_s = player.signals, time.monotonic()
                found = await fleet.measure(seconds)
                signals = (player.signals - before) / (time.monotonic() - began_s)
                return {"plates": plates, "signals/s": signals, "player behind_s": max(player.behind_s, 0.0)} | found
            finally:
                await asyncio.to_thread(player.stop)


def of_topics(kept: Kept) -> dict[str, dict[str, float]]:
    sizes: defaultdict[str, list[int]] = defaultdict(list)
    for at_s, path, payload in kept:
        if at_s > 0.0:
            sizes[path].append(len(payload))
    return {
        path: {"messages/s": len(each) / KEPT_S, "bytes": sum(each) / len(each)} for path, each in sorted(sizes.items())
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--daemons", type=int, default=1, help="real ones, with emulated boards (default: 1)")
    parser.add_argument("--plates", type=int, action="append", help="played ones; may be repeated (default: 4, 16, 64)")
    parser.add_argument("--decoders", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each row")
    parser.add_argument("--json", action="store_true", help="one object")
    given = parser.parse_args()
    found, kept = asyncio.run(live(given.daemons, given.decoders, given.seconds))
    rows = [asyncio.run(played(kept, plates, given.decoders, given.seconds)) for plates in given.plates or [4, 16, 64]]
    result = {"daemons": given.daemons, "decoders": given.decoders, "live": found, "topics": of_topics(kept)}
    if given.json:
        print(json.dumps(result | {"played": rows}))
        return 0
    print(f"{given.daemons} daemons with emulated {PLATE}, {given.decoders} decoders; rates per second")
    for name, value in found.items():
        print(f"  {name:28} {value:14.1f}")
    print(f"topics of one daemon: {'messages/s':>12} {'bytes':>8}")
    for path, row in result["topics"].items():
        print(f"  {path:28} {row['messages/s']:6.1f} {row['bytes']:8.0f}")
    names = list(rows[0])
    print("played plates, a column for each count")
    for name in names:
        print(f"  {name:28}", *(f"{row.get(name, 0.0):14.1f}" for row in rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
