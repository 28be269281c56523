"""Contact events through outages: those made, received live, received by the command `events`, and missing.

Run it with `make soak`, or `python benchmarks/event_delivery.py [--case NAME]`, 5 minutes for all cases. Board, broker,
daemon and client are processes; the client shares no code with the daemon. The emulator's truth has the touches that
really happened, five a second. Exit code 1 when an event is missing, does not come live, comes twice without the mark
`replayed`, out of order or with other contents, or a touch has no onset or release.

All events come live, also those of outages: the daemon holds them until a client subscribes, for up to 60 s after its
connection. A client that returns later, or a broker of MQTT 3.1.1, needs the command.
"""

import argparse
import asyncio
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiomqtt
from event_client import NoAnswerError, ask_events
from event_ledger import Ledger, Touch, read_touches, received
from system_parts import NAME, Part, free_port, mosquitto_command

_BASE = f"resonator/{NAME}"
_COMMAND = (sys.executable, "-m", "resonator_daemon")
_BENCHMARKS = Path(__file__).parent
_START_S = 30.0
_LOOK_S = 0.1
_BEFORE_S = 3.0
_CAUGHT_UP_S = 30.0  # for what waited to be delivered
_IN_FLIGHT_S = 1.5
_MARGIN_NS = 500_000_000  # around a run of the daemon, in which touches may be detected or not
_FROZEN_S = 20.0
_DEAD_S = 4.0
_READ_S = 0.5  # what a client has received
_RETURNED_S = 7.0  # the subscriber after the broker
_SHARED_S = 10.0
_HUNG_S = 50.0
_JUNK = 9000  # retained topics
_TOUCHED = ((7, 1.0), (1, 0.2), (13, 4.0))  # site and force, one after the other
_TOUCH_EVERY_S = 0.2
_TOUCH = "[[touches]]\nstart_s = {:.2f}\nsite = {}\nforce_newton = {}\nrise_s = 0.02\nhold_s = 0.06\nfall_s = 0.02\n"


def scenario() -> str:
    """Return a scenario with five touches a second, ten events, on three sites in turn."""
    touches = (_TOUCH.format(0.02 + n * _TOUCH_EVERY_S, *touch) for n, touch in enumerate(_TOUCHED))
    return f"period_s = {len(_TOUCHED) * _TOUCH_EVERY_S}\n[plate]\nideal = true\n" + "".join(touches)


@dataclass
class Run:
    """One run of a daemon: when it measured, and the truth about its plate."""

    truth: Path
    since_ns: int  # UTC
    until_ns: int = 0


@dataclass
class Plate:
    """An emulated board and a daemon for it."""

    board: Part
    daemon: Part
    truth: Path


@dataclass
class Scene:
    """One case: a broker, plates of the same name, a client, and the account of the events."""

    folder: Path
    port: int = field(default_factory=free_port)
    ledger: Ledger = field(default_factory=Ledger)
    runs: dict[str, Run] = field(default_factory=dict)  # by daemon_boot_id
    plates: list[Plate] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.broker = Part("broker", mosquitto_command(self.port, self.folder), self.folder / "broker.log", {})
        self._recorded = self.folder / "received.jsonl"
        command = (sys.executable, str(_BENCHMARKS / "event_client.py"), str(self.port), _BASE, str(self._recorded))
        self.client = Part("client", command, self.folder / "client.log", {})

    async def start_broker(self) -> None:
        """Start a broker without a store, and return when it accepts connections."""
        self.broker.start()
        while True:
            try:
                _, writer = await asyncio.open_connection("127.0.0.1", self.port)
            except OSError:
                await asyncio.sleep(_LOOK_S)
            else:
                writer.close()
                return

    def kill_broker(self) -> None:
        self.broker.end(signal.SIGKILL)

    async def start_plate(self) -> str:
        """Start a further board and its daemon, all of the same name; return the `daemon_boot_id`."""
        place = self.folder / f"plate-{len(self.plates)}"
        place.mkdir()
        (place / "touches.toml").write_text(scenario())
        link, truth, config = place / "port", place / "truth.jsonl", place / "board.toml"
        config.write_text(
            f'name = "{NAME}"\nplate = "quartz16"\nlink = "serial:{link}?baud=4000000"\n'
            f'[mqtt]\nurl = "mqtt://127.0.0.1:{self.port}"\n'
        )
        emulate = ("emulate", "--plate", "quartz16", "--pty", str(link), "--truth", str(truth))
        environment = {
            "XDG_STATE_HOME": str(place / "state"),
            "XDG_CACHE_HOME": str(place / "cache"),
            "OMP_NUM_THREADS": "1",
        }
        board = Part(
            "board",
            (*_COMMAND, *emulate, "--scenario", str(place / "touches.toml")),
            place / "board.log",
            environment,
            leftover=link,
        )
        daemon = Part("daemon", (*_COMMAND, "run", "--config", str(config)), place / "daemon.log", environment)
        plate = Plate(board, daemon, truth)
        self.plates.append(plate)
        board.start()
        return await self.start_daemon(plate)

    async def start_daemon(self, plate: Plate) -> str:
        """Start the daemon of a plate; return its `daemon_boot_id` when the client has received its first forces."""
        plate.daemon.start()
        until_s = time.monotonic() + _START_S
        while time.monotonic() < until_s:
            for run, since_ns in self._read_client().items():
                if run not in self.runs:
                    self.runs[run] = Run(plate.truth, since_ns)
                    return run
            await asyncio.sleep(_LOOK_S)
        raise RuntimeError(f"no forces within {_START_S:g} s; daemon: {plate.daemon.last_log_line()}")

    async def settle(self, run: str, *, ended_ns: int | None = None) -> None:
        """Count the events that a run has made until now, and close the client's gaps by the command `events`.

        Parameters
        ----------
        run
            The `daemon_boot_id`.
        ended_ns
            When the run ended, UTC; None: it goes on.
        """
        ledger = self.ledger
        self.runs[run].until_ns = (ended_ns or time.time_ns()) - _MARGIN_NS
        newest = await self._newest(run)
        await asyncio.sleep(_IN_FLIGHT_S)
        self._read_client()
        ledger.made[run] = max(newest, ledger.newest(run) if ended_ns else -1) + 1
        while gaps := ledger.gaps(run):
            answer = await ask_events(self.port, _BASE, run, gaps[0] - 1)
            ledger.by_command += [received(message) for message in answer["events"]]
            if ledger.gaps(run) == gaps:
                return

    async def caught_up(self, run: str) -> None:
        """Wait until the client has what waited for it, as far as it comes without the command."""
        until_s = time.monotonic() + _CAUGHT_UP_S
        while time.monotonic() < until_s:
            newest = await self._newest(run)
            await asyncio.sleep(_LOOK_S)
            self._read_client()
            if self.ledger.newest(run) >= newest:
                return

    async def _newest(self, run: str) -> int:
        answer = await ask_events(self.port, _BASE, run, max(self.ledger.newest(run), -1))
        return -1 if answer["newest_seq"] is None else int(answer["newest_seq"])

    def _read_client(self) -> dict[str, int]:
        """Read what the client received so far; return since when each run has measured forces."""
        since: dict[str, int] = {}
        self.ledger.live.clear()
        for line in self._recorded.read_text().splitlines(keepends=True) if self._recorded.exists() else ():
            if not line.endswith("\n"):
                break
            record = json.loads(line)
            message: dict[str, Any] = record["message"]
            if record["path"] == "contacts/event":
                self.ledger.live.append(received(message))
            elif record["path"] == "forces":
                since.setdefault(message["daemon_boot_id"], int(message["t_ns"]))
        return since

    def end(self) -> None:
        plates = [part for plate in self.plates for part in (plate.daemon, plate.board)]
        for part in (self.client, *plates, self.broker):
            if part.running:
                part.end(signal.SIGKILL)


async def _plain(scene: Scene) -> str:
    """Start everything; return the `daemon_boot_id` when it has run for some seconds."""
    await scene.start_broker()
    scene.client.start()
    run = await scene.start_plate()
    await asyncio.sleep(_BEFORE_S)
    return run


async def _finish(scene: Scene, run: str) -> None:
    await scene.caught_up(run)
    await scene.settle(run)


async def _frozen(scene: Scene) -> None:
    run = await _plain(scene)
    os.kill(scene.broker.pid, signal.SIGSTOP)
    await asyncio.sleep(_FROZEN_S)
    os.kill(scene.broker.pid, signal.SIGCONT)
    await _finish(scene, run)


async def _wiped(scene: Scene, times: int = 1) -> None:
    run = await _plain(scene)
    for _ in range(times):
        scene.kill_broker()
        await asyncio.sleep(_DEAD_S)
        await scene.start_broker()
        await asyncio.sleep(_BEFORE_S)
    await _finish(scene, run)


async def _killed_thrice(scene: Scene) -> None:
    await _wiped(scene, 3)


async def _late_subscriber(scene: Scene) -> None:
    """Wipe the broker, whose only subscriber returns later than the daemon: all events wait for it."""
    run = await _plain(scene)
    scene.kill_broker()
    await asyncio.sleep(_READ_S)  # the client has what the broker had sent
    scene.client.end(signal.SIGKILL)
    await asyncio.sleep(_DEAD_S)
    await scene.start_broker()
    await asyncio.sleep(_RETURNED_S)
    scene.client.start()
    await _finish(scene, run)


async def _second_daemon(scene: Scene) -> None:
    first = await _plain(scene)
    second = await scene.start_plate()
    await asyncio.sleep(_SHARED_S)
    await scene.settle(second)
    scene.plates[1].daemon.end(signal.SIGTERM)
    await asyncio.sleep(_BEFORE_S)
    await _finish(scene, first)


async def _hung_client(scene: Scene) -> None:
    run = await _plain(scene)
    os.kill(scene.client.pid, signal.SIGSTOP)
    await asyncio.sleep(_HUNG_S)
    os.kill(scene.client.pid, signal.SIGCONT)
    await asyncio.sleep(_BEFORE_S)
    await _finish(scene, run)


async def _killed_daemon(scene: Scene) -> None:
    first = await _plain(scene)
    await asyncio.sleep(_BEFORE_S)
    plate = scene.plates[0]
    killed_ns = time.time_ns()
    plate.daemon.end(signal.SIGKILL)
    second = await scene.start_daemon(plate)
    await asyncio.sleep(_BEFORE_S)
    await scene.settle(first, ended_ns=killed_ns)
    await _finish(scene, second)


async def _retained_junk(scene: Scene) -> None:
    await scene.start_broker()
    async with aiomqtt.Client("127.0.0.1", scene.port) as client:
        for n in range(_JUNK):
            base = _BASE if n % 2 else f"resonator/junk-{n}"
            await client.publish(f"{base}/junk/{n}", b"junk", qos=int(n == _JUNK - 1), retain=True)
    scene.client.start()
    run = await scene.start_plate()
    await asyncio.sleep(_BEFORE_S)
    await _finish(scene, run)


CASES: dict[str, Callable[[Scene], Awaitable[None]]] = {
    "frozen-broker": _frozen,
    "wiped-broker": _wiped,
    "broker-killed-thrice": _killed_thrice,
    "late-subscriber": _late_subscriber,
    "second-daemon": _second_daemon,
    "hung-client": _hung_client,
    "retained-junk": _retained_junk,
    "killed-daemon": _killed_daemon,
}
_COLUMNS = ("touches", "made", "live", "+ command", "missing", "unmarked", "disorder", "differing", "unreported")


async def measure(case: str, folder: Path) -> list[str]:
    """Play one case; print its row and return what was wrong."""
    scene = Scene(folder)
    try:
        await CASES[case](scene)
    except NoAnswerError as error:
        scene.wrong.append(str(error))
    finally:
        scene.end()
    ledger, touches, unreported = scene.ledger, 0, 0
    by_truth = {plate.truth: read_touches(plate.truth) for plate in scene.plates}
    for identifier, run in scene.runs.items():
        expected = _within(by_truth[run.truth], run)
        touches += len(expected)
        unreported += len(ledger.unreported(expected, identifier))
    figures = (
        touches,
        sum(ledger.made.values()),
        len(ledger.numbers(with_command=False)),
        len(ledger.numbers(with_command=True)),
        ledger.missing,
        ledger.doubles_unmarked,
        ledger.out_of_order,
        ledger.contradictions,
        unreported,
    )
    print(f"{case:21}" + "".join(f"{figure:11}" for figure in figures), flush=True)
    named = zip(_COLUMNS[4:], figures[4:], strict=True)
    wrong = [*scene.wrong, *(f"{name} {figure}" for name, figure in named if figure)]
    for identifier in scene.runs:
        if spans := ledger.not_live(identifier):
            named_spans = ", ".join(f"{first} to {last}" for first, last in spans)
            wrong.append(f"not received live: seq {named_spans} of {ledger.made[identifier]}, run {identifier}")
    if not touches or not figures[2]:
        wrong.append("no touches, or no events received")
    return [f"{case}: {words}" for words in wrong]


def _within(touches: list[Touch], run: Run) -> list[Touch]:
    since_ns = run.since_ns + _MARGIN_NS
    return [touch for touch in touches if touch.start_ns >= since_ns and touch.end_ns <= run.until_ns]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", action="append", choices=CASES, help="repeat it for several (default: all)")
    options = parser.parse_args()
    print(f"{'case':21}" + "".join(f"{column:>11}" for column in _COLUMNS), flush=True)
    wrong = []
    for case in options.case or CASES:
        with tempfile.TemporaryDirectory() as folder:
            wrong += asyncio.run(measure(case, Path(folder)))
    for words in wrong:
        print(words)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
