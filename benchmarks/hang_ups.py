"""Random hang-ups and returns of a board, its terminal under another name each time: the daemon always comes back.

Run it with `make soak`, or `python benchmarks/hang_ups.py [TIMES]`. Exit code 1 when it ended, leaked or came late.
The whole daemon runs in this process, against an emulated board in another thread and a broker that is not there.
"""

import asyncio
import logging
import os
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from resonator_daemon.daemon.config_store import ConfigStore
from resonator_daemon.daemon.daemon import Service
from resonator_daemon.session.frames import Arrival, Outage, SingleToneFrame
from simulators.emulator import Emulator, EmulatorOptions
from simulators.faults import FaultEvent, FaultPlan

RECOVERY_LIMIT_S = 1.5
PATIENCE_S = 30.0
_SHORT_SHARE = 0.1  # of the returns: gone again before a board can be started


@dataclass(frozen=True)
class Result:
    """What was seen over all hang-ups."""

    hang_ups: int
    lasting: int  # returns that lasted longer than the recovery may take
    recoveries_s: list[float]  # of these: from the return of the port to the first frame
    outages: int
    frames_lost: int
    more: dict[str, int]  # open files and the like, less those at first

    @property
    def p99_s(self) -> float:
        return float(np.quantile(self.recoveries_s, 0.99)) if self.recoveries_s else float("inf")

    @property
    def wrong(self) -> list[str]:
        found = [f"{count} more {what} than at first" for what, count in self.more.items() if count > 0]
        if len(self.recoveries_s) != self.lasting:
            found.append(f"frames came after {len(self.recoveries_s)} of {self.lasting} returns")
        if self.p99_s > RECOVERY_LIMIT_S:
            found.append(f"p99 of the recovery is {self.p99_s:.2f} s, more than {RECOVERY_LIMIT_S:g} s")
        return found


class _Watched(Service):
    """The daemon, with a note of when frames came again and what was told of outages."""

    def watch(self) -> None:
        self.frames = 0
        self.back_s: list[float] = []
        self.outages: list[Outage] = []
        self._last_s = 0.0

    def _handle(self, arrival: Arrival | list[SingleToneFrame]) -> None:
        if isinstance(arrival, list):
            self.frames += len(arrival)
        elif isinstance(arrival, Outage):
            self.outages.append(arrival)
            self.back_s.append(time.monotonic())
        super()._handle(arrival)


def hang_up(times: int, folder: Path, seed: int = 0) -> Result:
    """Pull the cable so many times and put it back.

    Raises
    ------
    TimeoutError
        When the daemon did not come back for far longer than it may take.
    """
    return asyncio.run(_hang_up(times, folder, np.random.default_rng(seed)))


async def _hang_up(times: int, folder: Path, random: np.random.Generator) -> Result:
    events, at_s = [], 1.0
    for number in range(times):
        out_s = float(random.exponential(0.15))
        events.append(FaultEvent(at_s=at_s, what="unplug", for_s=out_s))
        short = random.random() < _SHORT_SHARE and number < times - 1
        at_s += out_s + float(random.uniform(0.0, 0.1) if short else random.uniform(0.0, 0.6) + RECOVERY_LIMIT_S / 2)
    emulator = Emulator(EmulatorOptions("quartz16", pty=folder / "board", faults=FaultPlan(events=tuple(events))))
    moves_s: list[float] = []  # out, in, out, in ...
    hang, plug_in = emulator.link.hang_up, emulator.link.plug_in

    def noted_hang() -> None:
        moves_s.append(time.monotonic())
        hang()

    def noted_plug_in() -> None:
        plug_in()
        moves_s.append(time.monotonic())

    emulator.link.hang_up, emulator.link.plug_in = noted_hang, noted_plug_in  # type: ignore[method-assign]
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    config = folder / "board.toml"
    config.write_text(
        f'name = "bench"\nplate = "quartz16"\nlink = "serial:{folder / "board"}?baud=4000000"\n'
        f'[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
    )
    board = threading.Thread(target=emulator.run, name="emulator")
    service = _Watched(ConfigStore(config, folder / "last-good"))
    service.watch()
    board.start()
    task = asyncio.create_task(service.run(), name="service")
    try:
        await _until(lambda: service.frames > 200, task)
        before = _open_things()
        await _until(lambda: len(moves_s) == 2 * times, task, at_s)
        await _until(lambda: bool(service.back_s) and service.back_s[-1] > moves_s[-1], task)
        after = _open_things()
    finally:
        service.stop()
        await task
        emulator.stop()
        await asyncio.to_thread(board.join)
    outs, ins = moves_s[:-1:2], moves_s[1::2]  # the last move is the emulator's own end
    ends = [*outs[1:], float("inf")]
    recoveries_s, lasting = [], 0
    for back_s, end_s in zip(ins, ends, strict=True):
        first_s = next((at_s for at_s in service.back_s if back_s < at_s < end_s), None)
        if first_s is not None:
            recoveries_s.append(first_s - back_s)
        lasting += first_s is not None or end_s - back_s > RECOVERY_LIMIT_S / 2
    lost = sum(outage.frames_lost for outage in service.outages)
    more = {what: after[what] - before[what] for what in before}
    return Result(times, lasting, recoveries_s, len(service.outages), lost, more)


def _open_things() -> dict[str, int]:
    return {
        "open files": len(os.listdir("/proc/self/fd")),
        "threads": threading.active_count(),
        "tasks": len(asyncio.all_tasks()),
    }


async def _until(reached: Callable[[], bool], task: "asyncio.Task[None]", expected_s: float = 0.0) -> None:
    deadline_s = time.monotonic() + expected_s + PATIENCE_S
    while not reached():
        if task.done():
            await task
            raise RuntimeError("the daemon ended")
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"nothing for {PATIENCE_S:g} s")
        await asyncio.sleep(0.02)


def main() -> int:
    times = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        result = hang_up(times, Path(folder))
    recoveries_s = np.sort(result.recoveries_s)
    print(f"{times} hang-ups, {result.outages} outages told, {result.frames_lost} frames lost")
    print(
        f"recovery after the port is back, {len(recoveries_s)} times: median {np.median(recoveries_s):.3f} s, "
        f"p99 {result.p99_s:.3f} s, longest {recoveries_s[-1]:.3f} s; at most {RECOVERY_LIMIT_S:g} s at p99"
    )
    print(f"less or more at the end than at first: {result.more}")
    print("; ".join(result.wrong) or "never ended, nothing leaked")
    return int(bool(result.wrong))


if __name__ == "__main__":
    sys.exit(main())
