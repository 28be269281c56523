"""How soon all states are right, and what is lost, after parts or a recorder were killed, or a cable was pulled.

Run it with `make soak`, or `python benchmarks/kills.py orders|recorders|hang-ups [--count N] [--seed N]`. Orders:
board, broker, decoder and daemon are ended by SIGKILL or SIGTERM and restored at random, half with a small skin that is
decoded in a process of its own, half with quartz16. Recorders: `resonatord record` is killed at random moments, and its
file read and repaired. Hang-ups: a board's terminal goes and comes back under another name. Exit code 1 when states
were wrong or late, a file lacks more than came since the last flush, or a survivor holds more than before.
"""

import argparse
import asyncio
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import aiomqtt
import cbor2
import numpy as np
from parts import (
    COMMAND,
    NAME,
    Part,
    Subscriber,
    emulated_board,
    free_port,
    holdings,
    mosquitto_command,
    own_directories,
    running,
    until,
    write_config,
)
from plates import SMALL_SKIN

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording.reader import open_recording
from resonator_daemon.board.recording.repair import RepairError, repair

CONVERGED_S = 60.0  # ends a run that never converges; the time that it takes is in the result
FIRST_START_S = 120.0  # a decoder is set up once, and kept
PAUSE_S = 0.5  # the longest between two kills or restores
FLOWING = 5  # messages
PLATE_STATES = ("state/daemon", "state/link", "state/sensor", "info")
# What a process may hold more of than when it was first seen to work: a pool of threads fills by and by, an allocator
# keeps what was freed. What leaks in each run exceeds this in a soak.
MORE_AT_MOST = {"threads": 8.0, "file_descriptors": 3.0, "rss_mb": 40.0}
LOSS_AT_MOST_S, RECORDED_S = 1.0, 2.5  # of a recording; the longest before a kill
OUT_S, RECOVERY_S, HANG_UP_HZ, GAP_S = 0.15, 1.5, 0.4, 0.1


class System:
    """Parts by name, and how to reach their broker."""

    def __init__(self, folder: Path, *, skin: bool) -> None:
        folder.mkdir()
        self.skin, self.port = skin, free_port()
        if skin:
            plate, port = str(folder / "small.toml"), free_port()
            Path(plate).write_text(SMALL_SKIN)
            board, link, leftover = ("--tcp", f"127.0.0.1:{port}"), f"tcp://127.0.0.1:{port}", None
        else:
            plate, leftover = "quartz16", folder / "port"
            board, link = ("--pty", str(leftover)), f"serial:{leftover}?baud=4000000"
        config = write_config(folder, plate, link, self.port, "[decoding]\nexternal = true\n" if skin else "")
        commands = {
            "board": (*COMMAND, "emulate", "--plate", plate, *board, "--scenario", "still"),
            "broker": mosquitto_command(self.port, folder),
            "daemon": (*COMMAND, "run", "--config", str(config)),
            **({"decoder": (*COMMAND, "decode", "--config", str(config))} if skin else {}),
        }
        environment = own_directories(folder)
        self.parts = {name: Part(name, words, folder / f"{name}.log", environment) for name, words in commands.items()}
        self.parts["board"].leftover = leftover

    def stop(self) -> None:
        for part in self.parts.values():
            if part.running:
                part.end(signal.SIGKILL)


class View:
    """What a subscriber sees that comes when the last part was restored: the last message of each topic."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._last: dict[str, Any] = {}
        self._came: Counter[str] = Counter()

    async def until_right(self, seconds: float) -> str:
        """Return what is still wrong after so long; "" as soon as nothing is."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while self.wrong():
                    with suppress(aiomqtt.MqttError):
                        async with aiomqtt.Client("127.0.0.1", self._system.port, timeout=1.0) as client:
                            await client.subscribe("resonator/#", qos=1)
                            async for message in client.messages:
                                self._take(message)
                                if not self.wrong():
                                    return ""
                    await asyncio.sleep(0.05)
        return self.wrong()

    def _take(self, message: aiomqtt.Message) -> None:
        topic, payload = message.topic.value.removeprefix("resonator/"), bytes(message.payload)
        if payload:
            self._last[topic] = json.loads(payload) if payload.startswith(b"{") else cbor2.loads(payload)
        self._came[topic] += not message.retain

    def wrong(self) -> str:
        """Return what is not as it must be while all parts run; an empty text where everything is."""
        stream = f"{NAME}/{'signals' if self._system.skin else 'forces'}"
        if self._came[stream] < FLOWING:
            return f"{self._came[stream]} messages on {stream}"
        living = self._last[stream]["daemon_boot_id"]
        for path in (*PLATE_STATES, "health"):
            message = self._last.get(f"{NAME}/{path}")
            if message is None or message["daemon_boot_id"] != living or message.get("state", "online") != "online":
                return f"{path} is {message}"
        return self._wrong_decoder() if self._system.skin else ""

    def _wrong_decoder(self) -> str:
        states = [s for topic, s in self._last.items() if topic.startswith("decoder/") and topic.endswith("/state")]
        pid = self._system.parts["decoder"].pid
        online = [state["decoder_id"] for state in states if state["state"] == "online"]
        if [f"-{pid}-" in identifier for identifier in online] != [True]:
            return f"decoders online: {online}, the living one is {pid}"
        decoded = f"{NAME}/decoded"
        if self._came[decoded] < FLOWING or self._last[decoded]["decoder_id"] != online[0]:
            return f"{self._came[decoded]} messages on {decoded}"
        return ""


async def kill_orders(runs: int, seed: int, folder: Path) -> list[str]:
    """Kill and restore parts, over and over; return what was wrong."""
    draw, kills, wrong, took_s = random.Random(seed), Counter[str](), list[str](), list[float]()
    for skin, share in ((True, (runs + 1) // 2), (False, runs // 2)):
        system = System(folder / f"skin-{skin}", skin=skin)
        first: dict[int, dict[str, float]] = {}
        try:
            for part in system.parts.values():
                part.start()
            for run in range(share + 1 if share else 0):
                said = await _one_order(system, draw, kills) if run else "the start"
                began_s = time.monotonic()
                found = await View(system).until_right(CONVERGED_S if run else FIRST_START_S)
                found += "".join(
                    f"; {p.name} ended: {p.last_log_line()}" for p in system.parts.values() if not p.running
                )
                if found:
                    return [*wrong, f"{CONVERGED_S:g} s after {said}: {found}"]
                took_s += [time.monotonic() - began_s] if run else []
                for part in system.parts.values():
                    held = part.holdings()
                    wrong += _more(part.name, first.setdefault(part.pid, held), held)
        finally:
            system.stop()
    took = f"median {np.median(took_s):.2f} s, longest {max(took_s):.2f} s"
    print(f"{len(took_s)} of {runs} orders, {dict(kills)}; from the last restore to right states: {took}")
    return wrong


def _more(name: str, before: dict[str, float], after: dict[str, float]) -> list[str]:
    more = {what: after[what] - before[what] for what in MORE_AT_MOST}
    return [f"{name} holds {amount:g} more {what}" for what, amount in more.items() if amount > MORE_AT_MOST[what]]


async def _one_order(system: System, draw: random.Random, kills: Counter[str]) -> str:
    """Kill some of the parts and restore them, in a random order with random pauses; return the order in words."""
    names = list(system.parts)
    steps = [name for name in draw.sample(names, draw.randint(1, len(names))) for _ in range(2)]
    draw.shuffle(steps)
    said = []
    for name in steps:
        part = system.parts[name]
        if part.running:
            number = draw.choice((signal.SIGKILL, signal.SIGTERM))
            kills[name] += 1
            is_ended = await asyncio.to_thread(part.end, number)
            said.append(f"{number.name} {name}{'' if is_ended else ', which did not end'}")
        else:
            part.start()
            said.append(f"start {name}")
        await asyncio.sleep(draw.uniform(0.0, PAUSE_S))
    return ", ".join(said)


def kill_recorders(runs: int, seed: int, folder: Path) -> list[str]:
    """Record, kill, read and repair, over and over; return what was wrong."""
    moments, lost_s, wrong, empty = random.Random(seed), list[float](), list[str](), 0
    with emulated_board("quartz16", folder) as board:
        config = folder / "record.toml"
        config.write_text(f'plate = "quartz16"\nlink = "{board.link}"\n')
        for number in range(runs):
            path, copy = folder / f"{number}.mcap", folder / f"{number}.repaired.mcap"
            command = [*COMMAND, "record", "--config", str(config), "--output", str(path)]
            process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            until(lambda path=path: path.exists() and path.stat().st_size > 0, "a recording")  # type: ignore[misc]
            time.sleep(moments.uniform(0.0, RECORDED_S))
            killed_ns = time.monotonic_ns()
            process.kill()
            process.wait()
            try:
                with open_recording(str(path), load_plate("quartz16")) as opened:
                    events = list(opened.events())
                if not events:  # killed before its first flush
                    empty += 1
                    continue
                repair(path, copy)
                with open_recording(str(copy)) as opened:
                    again = list(opened.events())
                if opened.damage is not None or again != events:
                    wrong.append(f"{path.name}: repaired, it is {opened.damage}, {len(again)} of {len(events)} events")
            except (LinkUnavailableError, RepairError, OSError) as error:
                wrong.append(f"{path.name}: {error}")
                continue
            lost_s.append(1e-9 * (killed_ns - events[-1].now.monotonic_ns))
            path.unlink()
            copy.unlink()
    longest_s = max(lost_s, default=0.0)
    print(
        f"{runs} kills, {empty} before the first flush: {len(lost_s)} files repaired; missing before the kill: "
        f"median {np.median(lost_s):.2f} s, longest {longest_s:.2f} s (required: at most {LOSS_AT_MOST_S:g} s)"
    )
    return wrong + [f"{longest_s:.2f} s are missing"] * (longest_s > LOSS_AT_MOST_S)


def hang_up(times: int, seed: int, _folder: Path) -> list[str]:
    """Let a board hang up so many times, and look how long no forces come; return what was wrong."""
    arrived_ns: list[int] = []
    faults = f"unplug_rate_hz={HANG_UP_HZ},unplug_for_s={OUT_S}"
    with running("quartz16", "--seed", str(seed), "--faults", faults) as system:
        subscriber = Subscriber(
            system.port, ("forces",), lambda _path, _payload, at_ns: arrived_ns.append(at_ns), qos=0
        )

        def connections() -> int:
            return int(json.loads(system.last.get("health", b'{"connections": 0}'))["connections"])

        until(lambda: connections() > 1, "a hang-up")
        before = holdings(system.daemon.pid)
        until(lambda: connections() > times, f"{times} hang-ups", 60.0 + 3.0 * times / HANG_UP_HZ)
        wrong = _more("daemon", before, holdings(system.daemon.pid))
        subscriber.close()
    gaps_s = [1e-9 * (after - at) for at, after in pairwise(arrived_ns) if after - at > GAP_S * 1e9]
    p50_s, p99_s = np.percentile(gaps_s, [50, 99]) - OUT_S
    print(f"{times} hang-ups of {OUT_S:g} s, {len(gaps_s)} gaps, longer by: median {p50_s:.2f} s, p99 {p99_s:.2f} s")
    return wrong + [f"p99 of the recovery is more than {RECOVERY_S:g} s"] * bool(p99_s > RECOVERY_S)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("orders", "recorders", "hang-ups"))
    parser.add_argument("--count", type=int, help="default: 200, of hang-ups 1000")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        asked = options.count or (1000 if options.what == "hang-ups" else 200), options.seed, Path(name)
        if options.what == "orders":
            wrong = asyncio.run(kill_orders(*asked))
        else:
            wrong = (kill_recorders if options.what == "recorders" else hang_up)(*asked)
    print("\n".join(wrong) or "nothing wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
