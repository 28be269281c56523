"""Which part of a fleet of skins on two bridged Mosquitto brokers costs what, and breaks first.

Run it with `python benchmarks/fleet.py [--daemons N] [--plates N]... [--decoders N] [--seconds S]`. Daemons publish to
the near broker; a bridge carries `signals` and `info` to the far broker, and results back. Decoders connect to the far
broker; the first follows `plate-0`, and so on. First, real daemons with emulated boards of skin32 run; the messages of
one are stored. Then a player publishes them under `--plates` names, at the real rate, over a connection for each.
Emulators and player are excluded. All parts share this computer: a row is valid if the player reaches its rate.
"""

import argparse
import json
import socket
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
from parts import COMMAND, START_S, child, emulated_board, free_port, mosquitto_command, processor_s, until

PLATE, KEPT_S, SYS_S = "skin32", 4.0, 3.0  # the brokers' counters come each second
BRIDGE = """connection far
address 127.0.0.1:{port}
bridge_protocol_version mqttv50
try_private true
topic resonator/+/info out 1
topic resonator/+/signals out 0
topic resonator/+/decoded/# in 0
topic resonator/+/contacts in 0"""
COUNTERS = {
    "bytes/received": "bytes in",
    "bytes/sent": "bytes out",
    "publish/messages/received": "messages in",
    "publish/messages/sent": "messages out",
    "publish/messages/dropped": "dropped",
}
DECODING = ("received", "decoded", "skipped", "unusable", "waiting")
Kept = list[tuple[float, str, bytes]]  # seconds, path below the plate, payload


class Broker:
    """A broker with its counters, and the health of the decoders on it."""

    def __init__(self, stack: ExitStack, folder: Path, *settings: str) -> None:
        folder.mkdir()
        self.port = free_port()
        words = mosquitto_command(self.port, folder, "sys_interval 1", "log_type error", *settings)
        self.pid = stack.enter_context(child(*words)).pid
        self.counters: dict[str, int] = {}
        self.health: dict[str, Any] = {}
        self.states: dict[str, str] = {}
        self.kept: Kept | None = None
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.on_message = self._take
        topics = ("$SYS/broker/#", "resonator/decoder/+/health", "resonator/decoder/+/state")
        client.on_connect = lambda client, *_: client.subscribe([(topic, 0) for topic in topics])
        client.reconnect_delay_set(1, 1)
        client.connect_async("127.0.0.1", self.port)
        client.loop_start()
        stack.callback(client.loop_stop)
        self._client = client
        until(client.is_connected, "a broker")

    def keep(self) -> Kept:
        """Return the messages of one plate, retained ones first; not those of its decoders."""
        self.kept, self._began_s = [], time.monotonic()
        self._client.subscribe("resonator/plate-0/#")
        time.sleep(KEPT_S)
        kept, self.kept = self.kept, None
        return kept

    def _take(self, _client: object, _data: object, message: mqtt.MQTTMessage) -> None:
        topic, payload = message.topic, message.payload
        if topic.startswith("$SYS"):
            if name := COUNTERS.get(topic.removeprefix("$SYS/broker/")):
                self.counters[name] = int(payload)
        elif topic.startswith("resonator/decoder/"):
            decoder = topic.split("/")[2]
            if topic.endswith("/health"):
                self.health[decoder] = json.loads(payload)
            elif payload:
                self.states[decoder] = json.loads(payload)["state"]
        elif self.kept is not None:
            path = topic.removeprefix("resonator/plate-0/")
            if not path.startswith(("decoded", "contacts")):
                self.kept.append((0.0 if message.retain else time.monotonic() - self._began_s, path, payload))

    def decoding(self) -> Counter[str]:
        plates = (plate for health in self.health.values() for plate in health["plates"].values())
        return sum((Counter({key: plate[key] for key in DECODING}) for plate in plates), Counter[str]())


class Fleet:
    """Two bridged brokers with decoders on the far one."""

    def __init__(self, stack: ExitStack, folder: Path, decoders: int) -> None:
        self.far = Broker(stack, folder / "far")
        self.near = Broker(stack, folder / "near", *BRIDGE.format(port=self.far.port).splitlines())
        self.parts: dict[str, list[int]] = {
            "near broker": [self.near.pid],
            "far broker": [self.far.pid],
            "decoders": [],
        }
        for number in range(decoders):
            config = folder / f"decoder-{number}.toml"
            config.write_text(f'name = "plate-{number}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{self.far.port}"\n')
            decoder = stack.enter_context(child(*COMMAND, "decode", "--config", str(config), OMP_NUM_THREADS="1"))
            self.parts["decoders"].append(decoder.pid)
        until(lambda: len(self.far.health) == decoders, "the decoders")

    def measure(self, seconds: float) -> dict[str, float]:
        """Return rates of both brokers and the decoders, and processor time of each part in percent of a core."""
        until(lambda: set(self.far.states.values()) == {"online"}, "decoded frames")
        time.sleep(SYS_S)
        before, spent_s, began_s = self._counts(), self._spent_s(), time.monotonic()
        time.sleep(seconds)
        took_s, after = time.monotonic() - began_s, self._counts()
        cores = {f"{name}, % of a core": 100 * (s - spent_s[name]) / took_s for name, s in self._spent_s().items()}
        return {name: (after[name] - before.get(name, 0)) / took_s for name in after} | cores

    def _spent_s(self) -> dict[str, float]:
        return {name: sum(map(processor_s, pids)) for name, pids in self.parts.items()}

    def _counts(self) -> dict[str, int]:
        brokers = {"near": self.near, "far": self.far}
        counts = {f"{name} {key}": n for name, broker in brokers.items() for key, n in broker.counters.items()}
        return counts | {f"frames {key}": value for key, value in self.far.decoding().items()}


def live(daemons: int, decoders: int, seconds: float) -> tuple[dict[str, float], Kept]:
    """Run real daemons with emulated boards; return the figures, and the messages of one."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        fleet = Fleet(stack, folder, decoders)
        fleet.parts["daemons"] = []
        for number in range(daemons):
            board = stack.enter_context(emulated_board(PLATE, folder))
            config, port = folder / f"plate-{number}.toml", fleet.near.port
            config.write_text(
                f'name = "plate-{number}"\nplate = "{PLATE}"\nlink = "{board.link}"\n'
                f'[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n[decoding]\nexternal = true\n'
            )
            daemon = stack.enter_context(child(*COMMAND, "run", "--config", str(config), OMP_NUM_THREADS="1"))
            fleet.parts["daemons"].append(daemon.pid)
        return fleet.measure(seconds), fleet.near.keep()


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
        info = next(payload for _, path, payload in kept if path == "info")
        for number in range(plates):
            identifier, base = f"player-{number}".encode(), f"resonator/plate-{number}/"
            connect = b"\0\4MQTT\4\2\0\0" + len(identifier).to_bytes(2) + identifier
            link = socket.create_connection(("127.0.0.1", port))
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.sendall(bytes([0x10, len(connect)]) + connect)
            link.recv(4)
            link.sendall(packet(base + "info", info, retain=True))
            self._plates.append((link, base))
        self._stream = [each for each in kept if each[0] > 0.0]
        self._over = threading.Event()
        self.signals, self.behind_s = 0, 0.0

    def run(self) -> None:
        began_s, turn = time.monotonic(), 0
        while not self._over.is_set():
            for due_s, path, payload in self._stream:
                self.behind_s = time.monotonic() - began_s - turn * KEPT_S - due_s
                if self._over.wait(max(0.0, -self.behind_s)):
                    break
                for link, base in self._plates:
                    link.sendall(packet(base + path, payload))
                self.signals += len(self._plates) * (path == "signals")
            turn += 1
        for link, _ in self._plates:
            link.close()

    def stop(self) -> None:
        self._over.set()
        self.join()


def played(kept: Kept, plates: int, decoders: int, seconds: float) -> dict[str, float]:
    with ExitStack() as stack:
        fleet = Fleet(stack, Path(stack.enter_context(tempfile.TemporaryDirectory())), decoders)
        player = Player(fleet.near.port, kept, plates)
        player.start()
        stack.callback(player.stop)
        until(lambda: set(fleet.far.states.values()) == {"online"}, "skins", START_S)
        before, began_s = player.signals, time.monotonic()
        found = fleet.measure(seconds)
        signals = (player.signals - before) / (time.monotonic() - began_s)
        return {"plates": plates, "signals": signals, "player behind, s": max(player.behind_s, 0.0)} | found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--daemons", type=int, default=1, help="real ones, with emulated boards (default: 1)")
    parser.add_argument("--plates", type=int, action="append", help="played ones; may be repeated (default: 4, 16, 64)")
    parser.add_argument("--decoders", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each row")
    given = parser.parse_args()
    found, kept = live(given.daemons, given.decoders, given.seconds)
    print(f"{given.daemons} daemons with emulated {PLATE}, {given.decoders} decoders; rates per second")
    for name, value in found.items():
        print(f"  {name:28} {value:14.1f}")
    sizes: defaultdict[str, list[int]] = defaultdict(list)
    for at_s, path, payload in kept:
        sizes[path] += [len(payload)] * (at_s > 0.0)
    print(f"topics of one daemon: {'messages/s':>12} {'bytes':>8}")
    for path, each in sorted(sizes.items()):
        print(f"  {path:28} {len(each) / KEPT_S:6.1f} {sum(each) / max(1, len(each)):8.0f}", flush=True)
    rows = [played(kept, plates, given.decoders, given.seconds) for plates in given.plates or [4, 16, 64]]
    print("played plates, a column for each count")
    for name in rows[0]:
        print(f"  {name:28}", *(f"{row.get(name, 0.0):14.1f}" for row in rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
