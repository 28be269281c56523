"""Which contact events, frames and messages are lost through outages of broker, client, disk and daemon.

Run it with `make soak`, or `python benchmarks/outages.py [--case NAME]... [--seconds S]`: an outage lasts S seconds
(default 60), that of the dead broker ten times as long. Board, broker, daemon and client are processes; the client
shares no code with the daemon and connects as mqtt.js does: MQTT 3.1.1, clean session, the next attempt after 1 s. The
emulator's truth has the touches that really happened, five a second. Exit code 1 when an event is missing, does not
come live, comes twice without the mark `replayed`, out of order or with other contents, a touch has no onset or
release, a frame was lost on input, an account does not balance, or the daemon's memory grew beyond its bound.

All events come live, also those of outages: the daemon holds them until a client subscribes, for up to 60 s after its
connection. The full disk needs root, for a small file system to fill.
"""

import argparse
import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import aiomqtt
import psutil
from long_run_judge import account_off
from parts import COMMAND, NAME, Part, free_port, mosquitto_command, own_directories
from relay import Relay, relay

BASE = f"resonator/{NAME}"
START_S, LOOK_S, BEFORE_S, CAUGHT_UP_S, IN_FLIGHT_S = 30.0, 0.1, 3.0, 60.0, 1.5
ANSWER_S, ATTEMPTS = 3.0, 4  # of the command `events`
MARGIN_NS = 500_000_000  # around a run of the daemon, in which touches may be detected or not
TOLERANCE_NS = 100_000_000  # of an event's time: the window, and the readings that a release takes
DETECTED_NEWTON = 0.02  # the force of an onset, by docs/reference/mqtt-topics.md
DEAD_S, READ_S, RETURNED_S, SHARED_S = 4.0, 0.5, 7.0, 10.0
SLOW_BYTES_PER_S, DISK_BYTES = 20_000, 512 * 1024  # a tenth of what is made
MEMORY_MORE_MB = 64.0  # 32 MB of streams, 4 MB of answers, 1024 events, and what the allocator keeps of that
TOUCH = "[[touches]]\nstart_s = {:.2f}\nsite = {}\nforce_newton = {}\nrise_s = 0.02\nhold_s = 0.06\nfall_s = 0.02\n"
TOUCHED = ((0.02, 7, 1.0), (0.22, 1, 0.2), (0.42, 13, 4.0))
SCENARIO = "period_s = 0.6\n[plate]\nideal = true\n" + "".join(TOUCH.format(*touch) for touch in TOUCHED)

# The client, a process of its own.


async def follow(port: int, path: str, out: TextIO) -> None:
    """Write what comes, a JSON object a line: events, `health`, and of `forces` the first message of a run."""
    runs: set[str] = set()
    while True:
        with suppress(aiomqtt.MqttError):
            async with aiomqtt.Client("127.0.0.1", port, keepalive=60) as client:
                await client.subscribe(f"{BASE}/{path}", qos=int(path == "contacts/event"))
                async for message in client.messages:
                    received = json.loads(bytes(message.payload))
                    if path != "forces" or received["daemon_boot_id"] not in runs:
                        print(json.dumps({"path": path, "message": received}), file=out, flush=True)
                    runs.add(received["daemon_boot_id"])
        await asyncio.sleep(1.0)


async def client(port: int, path: Path) -> None:
    with path.open("a") as out:
        await asyncio.gather(*(follow(port, topic, out) for topic in ("contacts/event", "forces", "health")))


# The account of events.


class Event(NamedTuple):
    """One message of `contacts/event`."""

    run: str  # daemon_boot_id
    seq: int
    replayed: bool
    kind: str
    site: int | None
    t_ns: int


def event_of(message: dict[str, Any]) -> Event:
    site, t_ns = message["contact"]["site"], int(message["t_ns"])
    return Event(message["daemon_boot_id"], message["seq"], message["replayed"], message["event"], site, t_ns)


class Touch(NamedTuple):
    """A touch that happened, while its force was enough for an event; UTC in ns."""

    site: int
    start_ns: int
    end_ns: int


def touches_of(truth: Path) -> Iterator[Touch]:
    """Yield the touches of an emulator's truth file, in the order of their ends."""
    present: dict[int, Touch] = {}
    for line in truth.read_text().splitlines(keepends=True):
        if not line.endswith("\n"):
            return  # of an emulator that was killed while it wrote
        if '"contacts": []' in line and not present:
            continue
        frame = json.loads(line)
        t_ns = int(frame["t_ns"])
        pressed = {c["id"]: c["site"] for c in frame["contacts"] if c["force_newton"][2] >= DETECTED_NEWTON}
        for number, site in pressed.items():
            present[number] = Touch(site, present[number].start_ns if number in present else t_ns, t_ns)
        for number in present.keys() - pressed.keys():
            yield present.pop(number)


def order_of(live: list[Event]) -> tuple[int, int]:
    """Return how many events came again without the mark, and how many for the first time after a later one."""
    seen: set[tuple[str, int]] = set()
    last: dict[str, int] = defaultdict(lambda: -1)
    unmarked = disorder = 0
    for event in live:
        if (event.run, event.seq) in seen:
            unmarked += not event.replayed
        else:
            disorder += event.seq < last[event.run]
            last[event.run] = max(last[event.run], event.seq)
        seen.add((event.run, event.seq))
    return unmarked, disorder


def unreported(touches: list[Touch], events: list[Event]) -> int:
    """Return the number of touches without an onset and a release at their times."""

    def near(kind: str, site: int, t_ns: int) -> bool:
        return any((e.kind, e.site) == (kind, site) and abs(e.t_ns - t_ns) <= TOLERANCE_NS for e in events)

    return sum(
        not (near("onset", touch.site, touch.start_ns) and near("release", touch.site, touch.end_ns))
        for touch in touches
    )


# One case.


class Plate(NamedTuple):
    """An emulated board and a daemon for it."""

    board: Part
    daemon: Part
    folder: Path


class Scene:
    """A broker, plates of the same name, a client, and what it received."""

    def __init__(self, folder: Path, seconds: float, stack: AsyncExitStack, case: str) -> None:
        self.folder, self.seconds, self.stack, self.case = folder, seconds, stack, case
        self.port = free_port()
        self.broker = Part("broker", mosquitto_command(self.port, folder), folder / "broker.log", {})
        self._received = folder / "received.jsonl"
        words = (sys.executable, __file__, "--client", str(self.port), str(self._received))
        self.client = Part("client", words, folder / "client.log", {})
        self.gate: Relay | None = None
        self.plates: list[Plate] = []
        self.runs: dict[str, tuple[Path, int]] = {}  # truth, and since when it measures, UTC, by daemon_boot_id
        self.until_ns: dict[str, int] = {}
        self.made: dict[str, int] = {}
        self.live: list[Event] = []
        self.by_command: list[Event] = []
        self.healths: list[dict[str, Any]] = []
        self.rss_mb: list[float] = []

    async def begin(self) -> str:
        """Start everything; return the `daemon_boot_id` when it has run for some seconds."""
        if self.case == "slow":
            self.gate = await self.stack.enter_async_context(relay(f"mqtt://127.0.0.1:{self.port}"))
        await self.start_broker()
        self.client.start()
        run = await self.start_plate()
        await asyncio.sleep(BEFORE_S)
        return run

    async def start_broker(self) -> None:
        """Start a broker without a store, and return when it accepts connections."""
        self.broker.start()
        while True:
            with suppress(OSError):
                _, writer = await asyncio.open_connection("127.0.0.1", self.port)
                writer.close()
                return
            await asyncio.sleep(LOOK_S)

    async def start_plate(self) -> str:
        """Start a further board and its daemon, all of the same name; return the `daemon_boot_id`."""
        place = self.folder / f"plate-{len(self.plates)}"
        (place / "state").mkdir(parents=True)
        if self.case == "full-disk":
            options = ("-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs")
            subprocess.run(["mount", *options, str(place / "state")], check=True)  # noqa: ASYNC221 - nothing else runs
            self.stack.callback(subprocess.run, ["umount", "-l", str(place / "state")], check=True)
        scenario, link, config = place / "touches.toml", place / "port", place / "board.toml"
        scenario.write_text(SCENARIO)
        port = self.gate.port if self.gate else self.port
        config.write_text(
            f'name = "{NAME}"\nplate = "quartz16"\nlink = "serial:{link}?baud=4000000"\n'
            f'[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
        )
        emulate = ("emulate", "--plate", "quartz16", "--pty", str(link), "--truth", str(place / "truth.jsonl"))
        words, environment = (*COMMAND, *emulate, "--scenario", str(scenario)), own_directories(place)
        board = Part("board", words, place / "board.log", environment, leftover=link)
        daemon = Part("daemon", (*COMMAND, "run", "--config", str(config)), place / "daemon.log", environment)
        self.plates.append(Plate(board, daemon, place))
        board.start()
        return await self.start_daemon(self.plates[-1])

    async def start_daemon(self, plate: Plate) -> str:
        """Start the daemon of a plate; return its `daemon_boot_id` when the client has received its first forces."""
        plate.daemon.start()
        until_s = time.monotonic() + START_S
        while time.monotonic() < until_s:
            for run, since_ns in self.read_client().items():
                if run not in self.runs:
                    self.runs[run] = plate.folder / "truth.jsonl", since_ns
                    return run
            await asyncio.sleep(LOOK_S)
        raise RuntimeError(f"no forces within {START_S:g} s; daemon: {plate.daemon.last_log_line()}")

    def read_client(self) -> dict[str, int]:
        """Read what the client received so far; return since when each run has measured forces."""
        since: dict[str, int] = {}
        self.live.clear()
        self.healths.clear()
        for line in self._received.read_text().splitlines(keepends=True) if self._received.exists() else ():
            if not line.endswith("\n"):
                break
            record = json.loads(line)
            message: dict[str, Any] = record["message"]
            if record["path"] == "contacts/event":
                self.live.append(event_of(message))
            elif record["path"] == "health":
                self.healths.append(message)
            else:
                since.setdefault(message["daemon_boot_id"], int(message["t_ns"]))
        return since

    async def ask_events(self, run: str, after_seq: int) -> dict[str, Any]:
        """Return the answer to the command `events`."""
        refusal: Any = "no answer"
        for attempt in range(ATTEMPTS):
            request = {"id": f"{after_seq}-{attempt}", "after_seq": after_seq, "daemon_boot_id": run}
            with suppress(TimeoutError, aiomqtt.MqttError):
                async with asyncio.timeout(ANSWER_S), aiomqtt.Client("127.0.0.1", self.port) as asking:
                    await asking.subscribe(f"{BASE}/rsp/events", qos=1)
                    await asking.publish(f"{BASE}/cmd/events", json.dumps(request), qos=1)
                    async for message in asking.messages:
                        answer: dict[str, Any] = json.loads(bytes(message.payload))
                        if answer["ok"] and answer["id"] == request["id"]:
                            return answer
                        refusal = answer
        raise RuntimeError(f"events of {run} after {after_seq}: {refusal}")

    def newest(self, run: str) -> int:
        return max((event.seq for event in self.live if event.run == run), default=-1)

    def missing(self, run: str, events: list[Event]) -> list[int]:
        present = {event.seq for event in events if event.run == run}
        return [seq for seq in range(self.made[run]) if seq not in present]

    async def settle(self, run: str, *, ended_ns: int | None = None) -> None:
        """Wait for what comes by itself, count the events that a run has made, and fill the gaps by the command."""
        until_s = time.monotonic() + CAUGHT_UP_S * (ended_ns is None)
        self.until_ns[run] = (ended_ns or time.time_ns()) - MARGIN_NS
        while True:
            answer = await self.ask_events(run, max(self.newest(run), -1))
            newest = -1 if answer["newest_seq"] is None else int(answer["newest_seq"])
            await asyncio.sleep(LOOK_S)
            self.read_client()
            if self.newest(run) >= newest or time.monotonic() > until_s:
                break
        await asyncio.sleep(IN_FLIGHT_S)
        self.read_client()
        self.made[run] = max(newest, self.newest(run) if ended_ns else -1) + 1
        while gaps := self.missing(run, [*self.live, *self.by_command]):
            answer = await self.ask_events(run, gaps[0] - 1)
            self.by_command += [event_of(message) for message in answer["events"]]
            if self.missing(run, [*self.live, *self.by_command]) == gaps:
                return

    async def watch_memory(self) -> None:
        while True:
            with suppress(IndexError, ValueError, psutil.NoSuchProcess):
                self.rss_mb.append(psutil.Process(self.plates[0].daemon.pid).memory_info().rss / 2**20)
            await asyncio.sleep(BEFORE_S)

    def end(self) -> None:
        plates = [part for plate in self.plates for part in (plate.daemon, plate.board)]
        for part in (self.client, *plates, self.broker):
            if part.running:
                part.end(signal.SIGKILL)


async def stopped(scene: Scene, part: Part) -> None:
    """Stop a process for the time of an outage."""
    os.kill(part.pid, signal.SIGSTOP)
    await asyncio.sleep(scene.seconds)
    os.kill(part.pid, signal.SIGCONT)
    await asyncio.sleep(BEFORE_S)


async def _frozen(scene: Scene) -> None:
    run = await scene.begin()
    await stopped(scene, scene.broker)
    await scene.settle(run)


async def _hung_client(scene: Scene) -> None:
    run = await scene.begin()
    await stopped(scene, scene.client)
    await scene.settle(run)


async def _killed(scene: Scene, *dead_s: float) -> None:
    run = await scene.begin()
    for seconds in dead_s:
        scene.broker.end(signal.SIGKILL)
        await asyncio.sleep(seconds)
        await scene.start_broker()
        await asyncio.sleep(BEFORE_S)
    await scene.settle(run)


async def _slow(scene: Scene) -> None:
    run = await scene.begin()
    assert scene.gate is not None  # noqa: S101 - of this case
    scene.gate.bytes_per_s = SLOW_BYTES_PER_S
    await asyncio.sleep(scene.seconds)
    scene.gate.bytes_per_s = None
    await scene.settle(run)


async def _full_disk(scene: Scene) -> None:
    """Kill the broker; fill the disk of the events meanwhile, when some are on it."""
    run = await scene.begin()
    scene.broker.end(signal.SIGKILL)
    await asyncio.sleep(scene.seconds / 3)
    filler = scene.plates[0].folder / "state" / "filler"
    with suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    await asyncio.sleep(scene.seconds / 3)
    filler.unlink()
    await asyncio.sleep(scene.seconds / 3)
    await scene.start_broker()
    await asyncio.sleep(BEFORE_S)
    await scene.settle(run)


async def _late_subscriber(scene: Scene) -> None:
    """Wipe the broker, whose only subscriber returns later than the daemon: all events wait for it."""
    run = await scene.begin()
    scene.broker.end(signal.SIGKILL)
    await asyncio.sleep(READ_S)  # the client has what the broker had sent
    scene.client.end(signal.SIGKILL)
    await asyncio.sleep(DEAD_S)
    await scene.start_broker()
    await asyncio.sleep(RETURNED_S)
    scene.client.start()
    await asyncio.sleep(BEFORE_S)
    await scene.settle(run)


async def _second_daemon(scene: Scene) -> None:
    first = await scene.begin()
    second = await scene.start_plate()
    await asyncio.sleep(SHARED_S)
    await scene.settle(second)
    scene.plates[1].daemon.end(signal.SIGTERM)
    await asyncio.sleep(BEFORE_S)
    await scene.settle(first)


async def _killed_daemon(scene: Scene) -> None:
    first = await scene.begin()
    killed_ns = time.time_ns()
    scene.plates[0].daemon.end(signal.SIGKILL)
    second = await scene.start_daemon(scene.plates[0])
    await asyncio.sleep(BEFORE_S)
    await scene.settle(first, ended_ns=killed_ns)
    await scene.settle(second)


CASES: dict[str, Callable[[Scene], Awaitable[None]]] = {
    "frozen": _frozen,
    "dead": lambda scene: _killed(scene, 10 * scene.seconds),
    "killed-thrice": lambda scene: _killed(scene, DEAD_S, DEAD_S, DEAD_S),
    "slow": _slow,
    "full-disk": _full_disk,
    "late-subscriber": _late_subscriber,
    "hung-client": _hung_client,
    "second-daemon": _second_daemon,
    "killed-daemon": _killed_daemon,
}
COLUMNS = (
    "touches",
    "made",
    "live",
    "not live",
    "missing",
    "unmarked",
    "disorder",
    "differing",
    "unreported",
    "lost",
    "off",
)


async def measure(case: str, seconds: float, folder: Path) -> list[str]:
    """Play one case; print its row and return what was wrong."""
    async with AsyncExitStack() as stack:
        scene = Scene(folder, seconds, stack, case)
        stack.callback(scene.end)
        watching = asyncio.create_task(scene.watch_memory())
        stack.callback(watching.cancel)
        await CASES[case](scene)
    everything = [*scene.live, *scene.by_command]
    touches = not_reported = 0
    for run, (truth, since_ns) in scene.runs.items():
        within = [
            t for t in touches_of(truth) if t.start_ns >= since_ns + MARGIN_NS and t.end_ns <= scene.until_ns[run]
        ]
        touches += len(within)
        not_reported += unreported(within, [event for event in everything if event.run == run])
    contents = defaultdict[tuple[str, int], set[object]](set)
    for event in everything:
        contents[event.run, event.seq].add((event.kind, event.site, event.t_ns))
    not_live = sum(len(scene.missing(run, scene.live)) for run in scene.made)
    lost = sum(n for key, n in scene.healths[-1]["lost"].items() if key not in ("skipped_late", "publish_dropped"))
    made, off = sum(scene.made.values()), [line for health in scene.healths for line in account_off(health)]
    row = (touches, made, made - not_live, not_live, sum(len(scene.missing(run, everything)) for run in scene.made))
    row += (*order_of(scene.live), sum(len(each) > 1 for each in contents.values()), not_reported, lost, len(off))
    more_mb = max(scene.rss_mb) - scene.rss_mb[1] if len(scene.rss_mb) > 2 and case != "killed-daemon" else 0.0
    print(f"{case:17}" + "".join(f"{figure:11}" for figure in row) + f"{more_mb:11.1f}", flush=True)
    wrong = [f"{name} {figure}" for name, figure in zip(COLUMNS[3:], row[3:], strict=True) if figure]
    wrong += [f"memory grew by {more_mb:.1f} MB"] * (more_mb > MEMORY_MORE_MB) + off[:1]
    return [f"{case}: {words}" for words in wrong + ["no touches, or no events"] * (not touches or not made)]


def main() -> int:
    if sys.argv[1:2] == ["--client"]:
        asyncio.run(client(int(sys.argv[2]), Path(sys.argv[3])))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", choices=CASES, help="repeat it for several (default: all)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each outage (default: %(default)g)")
    options = parser.parse_args()
    print(f"{'case':17}" + "".join(f"{column:>11}" for column in (*COLUMNS, "memory, MB")), flush=True)
    wrong = []
    for case in options.case or CASES:
        if case == "full-disk" and os.geteuid():
            print(f"{case}: skipped, as it needs root", flush=True)
            continue
        with tempfile.TemporaryDirectory() as folder:
            wrong += asyncio.run(measure(case, options.seconds, Path(folder)))
    print("\n".join(wrong) or "nothing wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
