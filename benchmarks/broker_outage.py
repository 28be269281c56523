"""A broker that is frozen, dead, wiped or slow, or a disk that is full meanwhile: what becomes of frames and messages.

Run it with `make soak`, or `python benchmarks/broker_outage.py [--seconds S] [--case NAME]`: each outage lasts S
seconds (default 60), that of the dead broker ten times as long. Exit code 1 when a frame was lost on input, an account
did not balance in any of the samples, memory grew beyond its bound, or events are missing, out of order or doubled
without a mark. The full disk needs root, for a small file system to fill.
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
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import aiomqtt
import psutil
from slow_gate import Gate
from system_parts import NAME, Part, free_port, mosquitto_command

from resonator_daemon.daemon.config_store import ConfigStore
from resonator_daemon.daemon.daemon import Service
from resonator_daemon.publishing.payloads import MessageAccount

_MEMORY_MORE_MB = 64.0  # 32 MB of streams, 4 MB of answers, 1024 events, and what the allocator keeps of that
_SAMPLE_S = 0.05
_BEFORE_S = 3.0
_AFTER_S = 60.0  # by then everything that waited has been sent
_QUIET_S = 1.0
_DELIVERED_S = 0.2
_RESTORED_S = 1.0
_SLOW_BYTES_PER_S = 20_000  # a tenth of what is made
_DISK_BYTES = 512 * 1024
_RETAINED = ("state/daemon", "state/link", "state/sensor", "info")
# Ten events a second, from twenty.
_TOUCHES = """
period_s = 0.2
[[touches]]
start_s = 0.02
site = 7
force_newton = 1.0
rise_s = 0.02
hold_s = 0.06
fall_s = 0.02
"""


def imbalance(account: MessageAccount) -> int:
    """Return made less the sum of what became of it."""
    return account.enqueued - (
        account.acknowledged
        + account.written
        + sum(account.dropped.values())
        + account.unknown_at_disconnect
        + account.waiting
    )


async def listening(port: int) -> None:
    """Return when somebody listens on the port."""
    while True:
        try:
            _, writer = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            await asyncio.sleep(_SAMPLE_S)
        else:
            writer.close()
            return


@dataclass
class Subscriber:
    """Subscriber that is connected whenever the daemon can reach the broker."""

    events: list[tuple[int, bool]] = field(default_factory=list)  # seq, replayed
    retained: set[str] = field(default_factory=set)  # since the last subscription
    restored: asyncio.Event = field(default_factory=asyncio.Event)  # all of them
    task: "asyncio.Task[None] | None" = None

    async def subscribe(self, port: int) -> None:
        """Listen from now on; returns when the broker has agreed."""
        self.retained.clear()
        self.restored.clear()
        ready = asyncio.get_running_loop().create_future()
        self.task = asyncio.create_task(self._listen(port, ready))
        await ready

    async def end(self) -> None:
        if self.task is not None:
            self.task.cancel()
            await asyncio.wait([self.task])

    async def _listen(self, port: int, ready: "asyncio.Future[None]") -> None:
        # It is to live through a frozen broker.
        with suppress(aiomqtt.MqttError):
            async with aiomqtt.Client("127.0.0.1", port, keepalive=3600, max_queued_incoming_messages=0) as client:
                for path in (*_RETAINED, "contacts/event"):
                    await client.subscribe(f"resonator/{NAME}/{path}", qos=1)
                ready.set_result(None)
                async for message in client.messages:
                    self._take(message)

    def _take(self, message: aiomqtt.Message) -> None:
        path = message.topic.value.removeprefix(f"resonator/{NAME}/")
        if path in _RETAINED:
            if b'"offline"' not in bytes(message.payload):
                self.retained.add(path)
            if self.retained.issuperset(_RETAINED):
                self.restored.set()
            return
        event = json.loads(bytes(message.payload))
        self.events.append((event["seq"], event["replayed"]))

    @property
    def doubles_unmarked(self) -> int:
        seen: set[int] = set()
        count = 0
        for seq, replayed in self.events:
            count += seq in seen and not replayed
            seen.add(seq)
        return count

    @property
    def out_of_order(self) -> int:
        """Events that came for the first time, and after a later one."""
        seen: set[int] = set()
        count, last = 0, -1
        for seq, _ in self.events:
            if seq not in seen:
                count += seq < last
                last = max(last, seq)
            seen.add(seq)
        return count

    @property
    def missing(self) -> int:
        """Of those up to the last that came."""
        numbers = {seq for seq, _ in self.events}
        return max(numbers, default=-1) + 1 - len(numbers)


@dataclass(frozen=True)
class Outcome:
    """What was seen in a case, the balance of its messages, and what is wrong."""

    seen: str
    balance: str
    wrong: list[str]


@dataclass
class Watch:
    """Samples of the daemon's accounts and memory."""

    service: Service
    samples: int = 0
    worst_imbalance: int = 0
    rss_first_mb: float = 0.0
    rss_most_mb: float = 0.0
    waiting_most: int = 0
    spooled_most: int = 0

    async def run(self) -> None:
        process = psutil.Process()
        self.rss_first_mb = process.memory_info().rss / 2**20
        while True:
            account = self.service.message_account
            self.samples += 1
            self.worst_imbalance = max(self.worst_imbalance, abs(imbalance(account)))
            self.waiting_most = max(self.waiting_most, account.waiting)
            self.spooled_most = max(self.spooled_most, account.spooled)
            self.rss_most_mb = max(self.rss_most_mb, process.memory_info().rss / 2**20)
            await asyncio.sleep(_SAMPLE_S)


@dataclass
class Scene:
    """One case: a broker behind a gate, the daemon, and who listens."""

    folder: Path
    broker: Part
    broker_port: int
    gate: Gate
    subscriber: Subscriber
    service: Service
    restored_s: float | None = None  # from the gate's opening to the whole retained set

    async def start_broker(self) -> None:
        """Start an empty broker, connect the subscriber, then let the daemon connect."""
        self.broker.start()
        await listening(self.broker_port)
        await self.subscriber.subscribe(self.broker_port)
        self.gate.opened = True
        opened = time.monotonic()
        with suppress(TimeoutError):
            await asyncio.wait_for(self.subscriber.restored.wait(), _AFTER_S)
        self.restored_s = time.monotonic() - opened

    async def kill_broker(self) -> None:
        self.gate.shut()
        await asyncio.sleep(_DELIVERED_S)  # what the broker had acknowledged is its own to lose, and not measured here
        await self.subscriber.end()
        self.broker.end(signal.SIGKILL)


async def _frozen(scene: Scene, seconds: float) -> None:
    os.kill(scene.broker.pid, signal.SIGSTOP)
    await asyncio.sleep(seconds)
    os.kill(scene.broker.pid, signal.SIGCONT)


async def _dead(scene: Scene, seconds: float) -> None:
    await scene.kill_broker()
    await asyncio.sleep(10 * seconds)
    await scene.start_broker()


async def _wiped(scene: Scene, _seconds: float) -> None:
    await scene.kill_broker()
    await scene.start_broker()


async def _slow(scene: Scene, seconds: float) -> None:
    scene.gate.bytes_per_s = _SLOW_BYTES_PER_S
    await asyncio.sleep(seconds)
    scene.gate.bytes_per_s = None


async def _full_disk(scene: Scene, seconds: float) -> None:
    await scene.kill_broker()
    await asyncio.sleep(seconds / 3)  # some events are on disk when it is full
    filler = scene.folder / "state" / "filler"
    with suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    await asyncio.sleep(seconds / 3)
    filler.unlink()
    await asyncio.sleep(seconds / 3)
    await scene.start_broker()


CASES: dict[str, Callable[[Scene, float], Awaitable[None]]] = {
    "frozen": _frozen,
    "dead": _dead,
    "wiped": _wiped,
    "slow": _slow,
    "full-disk": _full_disk,
}


@contextmanager
def _small_disk(path: Path, *, wanted: bool) -> Iterator[None]:
    """Mount a small file system, as root."""
    if wanted:
        options = ("-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs")
        subprocess.run(["mount", *options, str(path)], check=True)
    try:
        yield
    finally:
        if wanted:
            subprocess.run(["umount", str(path)], check=True)


@contextmanager
def _emulated(folder: Path) -> Iterator[tuple[str, Callable[[], dict[str, int]]]]:
    """Run an emulated board; yield its link, and what ends it and returns its account."""
    scenario = folder / "touches.toml"
    scenario.write_text(_TOUCHES)
    board = ("--plate", "quartz16", "--pty", str(folder / "board"), "--scenario", str(scenario))
    command = (sys.executable, "-m", "resonator_daemon", "emulate", *board, "--json")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    if process.stdout is None:
        raise RuntimeError("the emulator's output is a pipe")

    def account() -> dict[str, int]:
        process.terminate()
        said, _ = process.communicate()
        return dict(json.loads(said.splitlines()[-1]))

    try:
        yield json.loads(process.stdout.readline())["link"], account
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


async def measure(case: str, seconds: float, folder: Path) -> Outcome:
    """Play one case; print a line."""
    state, port = folder / "state", free_port()
    state.mkdir()
    os.environ["XDG_STATE_HOME"] = str(state)
    broker = Part("broker", mosquitto_command(port, folder, "max_queued_messages 0"), folder / "broker.log", {})
    with _small_disk(state, wanted=case == "full-disk"), _emulated(folder) as (link, board_account):
        async with Gate(port).standing() as gate:
            path = folder / "board.toml"
            url = f"mqtt://127.0.0.1:{gate.port}"
            path.write_text(f'name = "{NAME}"\nplate = "quartz16"\nlink = "{link}"\n[mqtt]\nurl = "{url}"\n')
            gate.opened = False
            subscriber = Subscriber()
            service = Service(ConfigStore(path, path.parent / "last-good"))
            running = asyncio.create_task(service.run())
            scene = Scene(folder, broker, port, gate, subscriber, service)
            try:
                await scene.start_broker()
                await asyncio.sleep(_BEFORE_S)
                scene.restored_s = None
                watch = Watch(service)
                watching = asyncio.create_task(watch.run())
                await CASES[case](scene, seconds)
                await _until_all_is_sent(service)
                made = service.message_account
                watching.cancel()
                service.stop()
                await running
                await asyncio.sleep(_QUIET_S)
                return _outcome(case, scene, watch, made, board_account())
            finally:
                await subscriber.end()
                broker.end(signal.SIGKILL)


async def _until_all_is_sent(service: Service) -> None:
    """Wait until events and states that waited are out; a few stream messages are always on their way."""
    until = time.monotonic() + _AFTER_S
    quiet = time.monotonic() + _QUIET_S
    while time.monotonic() < min(until, quiet):
        account = service.message_account
        if account.waiting > 20 or account.spooled:
            quiet = time.monotonic() + _QUIET_S
        await asyncio.sleep(_SAMPLE_S)


def _outcome(case: str, scene: Scene, watch: Watch, before_end: MessageAccount, board: dict[str, int]) -> Outcome:
    account, link, subscriber = scene.service.message_account, scene.service.link_counters, scene.subscriber
    off = max(watch.worst_imbalance, abs(imbalance(account)))
    more_mb = watch.rss_most_mb - watch.rss_first_mb
    excused = sum(account.dropped.get(cause, 0) for cause in ("spool_full", "spool_failed"))
    restored = "" if scene.restored_s is None else f", retained set back after {scene.restored_s:.2f} s"
    print(
        f"{case:9}  frames {link.frames}, lost {link.lost.total}, board made {board['frames_made']}; messages "
        f"{account.enqueued}, off by {off} in {watch.samples} samples, acknowledged {account.acknowledged}, written "
        f"{account.written}, dropped {dict(account.dropped)}, unknown {account.unknown_at_disconnect}, resent "
        f"{account.resent}; waiting at most {watch.waiting_most}, on disk {watch.spooled_most}; memory "
        f"{watch.rss_first_mb:.0f} MB + {more_mb:.1f} MB; events received {len(subscriber.events)}, "
        f"{sum(replayed for _, replayed in subscriber.events)} replayed, missing {subscriber.missing}, out of order "
        f"{subscriber.out_of_order}, doubled unmarked {subscriber.doubles_unmarked}{restored}",
        flush=True,
    )
    findings = {
        f"{link.lost.total} frames lost on input": link.lost.total,
        f"accounts off by {off}": off,
        f"memory grew by {more_mb:.1f} MB, more than {_MEMORY_MORE_MB:g} MB": more_mb > _MEMORY_MORE_MB,
        f"{before_end.spooled} events still on disk": before_end.spooled,
        f"{subscriber.missing} events missing, {excused} accounted for": subscriber.missing > excused,
        f"{subscriber.out_of_order} events out of order": subscriber.out_of_order,
        f"{subscriber.doubles_unmarked} events twice without a mark": subscriber.doubles_unmarked,
        f"retained set only after {scene.restored_s} s": (scene.restored_s or 0.0) > _RESTORED_S,
        "no events received": not subscriber.events,
    }
    return Outcome(
        f"{link.frames} frames, {link.lost.total} lost; {len(subscriber.events)} events, {subscriber.missing} missing",
        f"{account.enqueued} messages, off by {off} in {watch.samples} samples",
        [f"{case}: {words}" for words, found in findings.items() if found],
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each outage; ten times that of a dead broker")
    parser.add_argument("--case", action="append", choices=CASES, help="repeat it for several (default: all)")
    options = parser.parse_args()
    wrong = []
    for case in options.case or CASES:
        if case == "full-disk" and os.geteuid():
            print(f"{case}: skipped, as it needs root", flush=True)
            continue
        with tempfile.TemporaryDirectory() as folder:
            wrong += asyncio.run(measure(case, options.seconds, Path(folder))).wrong
    for words in wrong:
        print(words)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
