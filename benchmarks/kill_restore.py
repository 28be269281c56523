"""Board, broker, decoder and daemon killed and restored in random orders: the states are right again within seconds.

Run it with `make soak`, or `python benchmarks/kill_restore.py [--runs N] [--seed N]`. Exit code 1 when states were
wrong or late, or a process that survived holds more than before. Every part is a process of its own, ended by SIGKILL
or SIGTERM: half of the runs with a small skin that is decoded in a process of its own, half with quartz16.
"""

import argparse
import asyncio
import json
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiomqtt
import cbor2
from system_parts import DAEMON, DECODER, NAME, System, quartz_system, skin_system

CONVERGED_S = 60.0  # ends a run that never converges; the time that it takes is in the result
_FIRST_START_S = 90.0  # a decoder is set up once, and kept
_PAUSE_S = 0.5  # the longest between two kills or restores
_AGAIN_S = 0.05
_FLOWING = 5  # messages
_PLATE_STATES = ("state/daemon", "state/link", "state/sensor", "info")
# What a process may hold more of than when it was first seen to work: a pool of threads fills by and by, an allocator
# keeps what was freed. What leaks in each run exceeds this in a soak.
_MORE_AT_MOST = {"tasks": 0.0, "threads": 8.0, "file_descriptors": 3.0, "rss_mb": 40.0}


@dataclass
class Result:
    """What was seen over all runs."""

    kills: Counter[str] = field(default_factory=Counter)  # by part
    converged_s: list[float] = field(default_factory=list)  # from the last restore to right states, by run
    more: dict[str, float] = field(default_factory=dict)  # the most that any process came to hold, by what
    longest_survival: int = 0  # runs that one process saw
    wrong: list[str] = field(default_factory=list)


class View:
    """What a subscriber sees that comes when the last part was restored: the last message of each topic."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._last: dict[str, bytes] = {}
        self._came: Counter[str] = Counter()
        self._news = asyncio.Event()

    async def listen(self) -> None:
        """Listen, to a broker that may be still starting, until cancelled."""
        while True:
            with suppress(aiomqtt.MqttError):
                async with aiomqtt.Client("127.0.0.1", self._system.port, timeout=1.0) as client:
                    await client.subscribe("resonator/#", qos=1)
                    async for message in client.messages:
                        self._take(message)
            await asyncio.sleep(_AGAIN_S)

    def _take(self, message: aiomqtt.Message) -> None:
        topic = message.topic.value.removeprefix("resonator/")
        self._last[topic] = bytes(message.payload)
        if not message.retain:
            self._came[topic] += 1
        self._news.set()

    async def until(self, seconds: float) -> str:
        """Return what is still wrong after so long; "" as soon as nothing is."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while self.wrong():
                    self._news.clear()
                    await self._news.wait()
        return self.wrong()

    def wrong(self) -> str:
        """Return what is not as it must be while all parts run; an empty text where everything is."""
        stream = f"{NAME}/{'signals' if self._system.external else 'forces'}"
        if self._came[stream] < _FLOWING:
            return f"{self._came[stream]} messages on {stream}"
        living = self._read(stream)["daemon_boot_id"]
        for path in _PLATE_STATES:
            message = self._read(f"{NAME}/{path}")
            if message is None:
                return f"no {path}"
            if message["daemon_boot_id"] != living:
                return f"{path} is of another run of the daemon: {message}"
            if message.get("state", "online") != "online":
                return f"{path} is {message['state']}: {message['reason']}"
        health = self._read(f"{NAME}/health")
        if self._came[f"{NAME}/health"] == 0 or health["daemon_boot_id"] != living:
            return "no health"
        return self._wrong_decoder() if self._system.external else ""

    def tasks(self) -> int:
        return int(self._read(f"{NAME}/health")["tasks"])

    def _wrong_decoder(self) -> str:
        states = [
            self._read(topic) for topic in self._last if topic.startswith("decoder/") and topic.endswith("/state")
        ]
        pid = self._system.parts[DECODER].pid
        online = [state["decoder_id"] for state in states if state["state"] == "online"]
        if [f"-{pid}-" in identifier for identifier in online] != [True]:
            return f"decoders online: {online}, the living one is {pid}; {[(s['state'], s['reason']) for s in states]}"
        decoded = f"{NAME}/decoded"
        if self._came[decoded] < _FLOWING or self._read(decoded)["decoder_id"] != online[0]:
            return f"{self._came[decoded]} messages on {decoded}"
        return ""

    def _read(self, topic: str) -> Any:
        payload = self._last.get(topic)
        if payload is None:
            return None
        return json.loads(payload) if payload.startswith(b"{") else cbor2.loads(payload)


class Holdings:
    """What each process holds after each run; one that was restored begins anew."""

    def __init__(self, result: Result) -> None:
        self._result = result
        self._first: dict[int, dict[str, float]] = {}
        self._runs: Counter[int] = Counter()

    def take(self, part: str, pid: int, held: dict[str, float]) -> None:
        first = self._first.setdefault(pid, held)
        self._runs[pid] += 1
        result = self._result
        result.longest_survival = max(result.longest_survival, self._runs[pid] - 1)
        for what, amount in held.items():
            more = amount - first[what]
            result.more[what] = max(result.more.get(what, 0.0), more)
            if more > _MORE_AT_MOST[what]:
                result.wrong.append(f"{part} holds {more:g} more of {what} after {self._runs[pid] - 1} runs")


async def kill_and_restore(
    runs: int,
    folder: Path,
    *,
    seed: int,
    systems: Sequence[Callable[[Path], System]] = (skin_system, quartz_system),
    converged_s: float = CONVERGED_S,
    tell: Callable[[str], None] = lambda _: None,
) -> Result:
    """Play random orders, in equal parts with each system; stop a system's runs at the first that does not converge."""
    result, draw = Result(), random.Random(seed)
    for n, make_system in enumerate(systems):
        place = folder / str(n)
        place.mkdir()
        system = make_system(place)
        system.start()
        try:
            await _play(system, _share(runs, n, len(systems)), draw, result, converged_s, tell)
        finally:
            system.stop()
    return result


async def _play(
    system: System, runs: int, draw: random.Random, result: Result, converged_s: float, tell: Callable[[str], None]
) -> None:
    holdings = Holdings(result)
    if wrong := await _look(system, holdings, _FIRST_START_S):
        result.wrong.append(f"at the first start: {wrong}")
        return
    names = list(system.parts)
    for run in range(runs):
        spared = names[run * len(names) // runs]  # for a while, so that it survives many runs
        order = await _one_order(system, [name for name in names if name != spared], draw, result)
        restored = time.monotonic()
        wrong = await _look(system, holdings, converged_s)
        took_s = time.monotonic() - restored
        tell(f"{took_s:5.2f} s  {order}")
        if wrong:
            words = "; ".join(f"last line of {part.name}: {part.last_log_line()}" for part in system.parts.values())
            result.wrong.append(f"{converged_s:g} s after {order}: {wrong} ({words})")
            return
        result.converged_s.append(took_s)


async def _one_order(system: System, names: Sequence[str], draw: random.Random, result: Result) -> str:
    """Kill some of the parts and restore them, in a random order with random pauses; return the order in words."""
    steps = [name for name in draw.sample(names, draw.randint(1, len(names))) for _ in range(2)]
    draw.shuffle(steps)
    said = []
    for name in steps:
        part = system.parts[name]
        if part.running:
            number = draw.choice((signal.SIGKILL, signal.SIGTERM))
            result.kills[name] += 1
            if not await asyncio.to_thread(part.end, number):
                result.wrong.append(f"{name} did not end with {number.name}")
            said.append(f"{number.name} {name}")
        else:
            part.start()
            said.append(f"start {name}")
        await asyncio.sleep(draw.uniform(0.0, _PAUSE_S) if name is not steps[-1] else 0.0)
    return ", ".join(said)


async def _look(system: System, holdings: Holdings, seconds: float) -> str:
    """Return what is wrong after so long, "" as soon as nothing is; then take down what the processes hold."""
    view = View(system)
    listening = asyncio.create_task(view.listen())
    try:
        wrong = await view.until(seconds)
    finally:
        listening.cancel()
        await asyncio.wait([listening])
    dead = [f"{part.name} ended: {part.last_log_line()}" for part in system.parts.values() if not part.running]
    if not wrong and not dead:
        for part in system.parts.values():
            tasks = {"tasks": float(view.tasks())} if part.name == DAEMON else {}
            holdings.take(part.name, part.pid, part.holdings() | tasks)
    return "; ".join(filter(None, (wrong, *dead)))


def _share(runs: int, n: int, of: int) -> int:
    return runs * (n + 1) // of - runs * n // of


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = asyncio.run(
            kill_and_restore(options.runs, Path(folder), seed=options.seed, tell=lambda line: print(line, flush=True))
        )
    took = sorted(result.converged_s)
    print(f"{len(took)} of {options.runs} runs converged; kills: {dict(result.kills)}")
    if took:
        print(f"from the last restore to right states: median {took[len(took) // 2]:.2f} s, most {took[-1]:.2f} s")
    print(f"most that a survivor of up to {result.longest_survival} runs came to hold more: {result.more}")
    for wrong in result.wrong:
        print(wrong)
    return 1 if result.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
