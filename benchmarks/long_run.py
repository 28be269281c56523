"""A daemon over a long time, under faults of everything around it: what it holds, counts, says and publishes.

Run it with `make soak MINUTES=60`, or `python benchmarks/long_run.py --minutes N [--seed N] [--json]`; seven days are
10080 minutes. `resonatord run` is a process of its own, with continuous recording in a small budget, metrics and the
status socket; so are an emulated board whose faults change every minute and a Mosquitto that dies and stands still.
Ctrl-C ends it early, in order and with the table of what was seen until then; a second one at once. Exit code 1 when a
figure is missed or the run was cut short.
"""

import argparse
import asyncio
import contextlib
import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from long_run_faults import BoardLeg, draw_leg
from long_run_judge import Leg, Row, Sample, Seen, judge, leg_of
from long_run_listener import Listener
from long_run_log import Cause, LogJudge, new_lines
from system_parts import BOARD, BROKER, DAEMON, NAME, Part, free_port, mosquitto_command
from watched_daemon import FILE_VARIABLE, InUse, ask_in_use

_COMMAND: Final = (sys.executable, "-m", "resonator_daemon")
_WATCHED: Final = (sys.executable, str(Path(__file__).with_name("watched_daemon.py")))
_SAMPLE_S: Final = 30.0
_SAMPLES_MIN: Final = 40  # of a short run
_LOOK_S: Final = 0.2
_BETWEEN_S: Final = (5.0, 30.0)  # disturbances besides the board's
_GONE_S: Final = (0.2, 3.0)  # without a board, from one leg to the next
_SETTLED_S: Final = 12.0  # at the end, with a board and a broker in order
_BUDGET_MB, _FILE_MB = 16, 4
_FLUSHED_MB: Final = 2.0  # what the writer holds before it looks at the budget
_BROKEN: Final = (Cause.BROKER_DEAD, Cause.BROKER_FROZEN)
_LOADED: Final = 0.2  # share of the time that some process waited for a core
_BAD: Final = ("plate = ", "[measurement]\nwindow_ms = -1\n", "[commands]\nallow = [7]\n", "\x00", None)


class Run:
    """Everything that runs, and what was seen of it."""

    def __init__(self, folder: Path, seed: int, tell: Callable[[str], None]) -> None:
        self.seen = Seen()
        self.log = LogJudge()
        self._folder = folder
        self._tell = tell
        self._draw = random.Random(seed)
        self._port, self._metrics = free_port(), free_port()
        self._config = folder / "board.toml"
        terminal = folder / "port"
        self._text = (
            f'name = "{NAME}"\nplate = "quartz16"\nlink = "serial:{terminal}?baud=4000000"\n'
            f'[mqtt]\nurl = "mqtt://127.0.0.1:{self._port}"\n'
            '[commands]\nallow = ["tare", "mark", "set_window", "start_recording", "stop_recording"]\n'
            f'[metrics]\nlisten = "127.0.0.1:{self._metrics}"\n'
            f'[recording]\nautostart = true\ninclude_messages = true\ndirectory = "{folder / "recordings"}"\n'
            f"file_max_mb = {_FILE_MB}\nfile_max_minutes = 2\nmax_total_mb = {_BUDGET_MB}\nmin_free_mb = 10\n"
        )
        self._config.write_text(self._text)
        self._environment = {
            "XDG_CACHE_HOME": str(folder / "cache"),
            "XDG_STATE_HOME": str(folder / "state"),
            "XDG_RUNTIME_DIR": str(folder / "run"),
            "OMP_NUM_THREADS": "1",
            FILE_VARIABLE: str(folder / "in_use.json"),
        }
        (folder / "run").mkdir(mode=0o700)
        self._terminal = terminal
        self._board = self._make_board("")
        broker = mosquitto_command(self._port, folder, "max_queued_messages 0", "log_dest none")
        self._broker = Part(BROKER, broker, folder / "broker.log", self._environment)
        run = (*_WATCHED, "run", "--config", str(self._config))
        self._daemon = Part(DAEMON, run, folder / "daemon.log", self._environment)
        self._listener = Listener(self._port, self.seen, lambda at_s: self.log.at_work(_BROKEN, at_s))
        self._read_bytes = 0
        self._over = asyncio.Event()

    async def play(self, seconds: float) -> None:
        """Run for so long, or until `cut_short`; then end all in order and take the last figures."""
        self._did(Cause.START, 15.0)
        self._broker.start()
        self._daemon.start()
        boards = asyncio.create_task(self._change_boards())
        others = [asyncio.create_task(work) for work in (self._disturb(), self._watch(seconds))]
        log = asyncio.create_task(self._read_log())
        began_s = time.monotonic()
        over = asyncio.create_task(self._over.wait())
        try:
            work = (boards, *others, log, over)
            ended, _ = await asyncio.wait(work, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            self.seen.asked_s, self.seen.ran_s = seconds, time.monotonic() - began_s
            for task in others:
                task.cancel()
            await asyncio.wait(others)
            self._set_right()
            self._over.set()  # the last board ends in order, and is judged by what it had sent
            await asyncio.wait([boards])
            await self._end()
            log.cancel()

    def cut_short(self) -> None:
        """End `play` early; from the event loop."""
        self.seen.cut_short = True
        self._over.set()

    def stop(self) -> None:
        """Kill whatever still runs."""
        self._listener.close()
        for part in (self._daemon, self._board, self._broker):
            if part.running:
                part.end(signal.SIGKILL)

    async def _end(self) -> None:
        self._start_board(BoardLeg(0.0, "", frozenset(), killed=False))
        await asyncio.sleep(_SETTLED_S)
        health = await asyncio.to_thread(self._listener.next_health, 5.0)
        if health is not None:
            self._take_totals(health)
        self._did(Cause.STOP, 15.0)
        self._did(Cause.GONE, 15.0)
        if await asyncio.to_thread(self._daemon.end, signal.SIGTERM) and self._daemon.process is not None:
            self.seen.exit_code = self._daemon.process.returncode
        self._take_lines()

    async def _change_boards(self) -> None:
        before = await asyncio.to_thread(self._listener.next_health, 20.0)
        while not self._over.is_set():
            leg = draw_leg(self._draw)
            self._start_board(leg)
            self._tell(f"board for {leg.seconds:.0f} s: {leg.faults or 'no faults'}")
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._over.wait(), leg.seconds)
            killed = leg.killed and not self._over.is_set()
            self._did(Cause.GONE, _GONE_S[1] + 1.0)
            await asyncio.to_thread(self._board.end, signal.SIGKILL if killed else signal.SIGINT)
            await asyncio.sleep(self._draw.uniform(*_GONE_S))
            after = await asyncio.to_thread(self._listener.next_health, 10.0)
            account = None if killed else self._board_account()
            if before is not None and after is not None and account is not None:
                self._take_leg(leg_of(leg.faults or "no faults", account, before, after))
            before = after  # without a board nothing comes

    def _take_leg(self, leg: Leg) -> None:
        self.seen.legs.append(leg)
        self._tell(
            f"{leg.arrived} frames arrived of {leg.sent} sent, {leg.hit} of them harmed; "
            f"{leg.missing} whole ones missing, at most {leg.excused}"
        )

    def _make_board(self, faults: str) -> Part:
        board = (*_COMMAND, "emulate", "--plate", "quartz16", "--pty", str(self._terminal), "--json")
        command = (*board, "--seed", str(self._draw.randrange(2**31)), *(("--faults", faults) if faults else ()))
        return Part(BOARD, command, self._folder / "board.log", self._environment, leftover=self._terminal)

    def _start_board(self, leg: BoardLeg) -> None:
        self._board.log.unlink(missing_ok=True)
        self._board = self._make_board(leg.faults)
        for cause in leg.causes:
            self._did(cause, leg.seconds)
        self._did(Cause.GONE, 5.0)  # it comes up only now
        self._board.start()

    def _board_account(self) -> dict[str, Any] | None:
        lines = [line for line in self._board.log.read_text().splitlines() if line.startswith('{"frames_made')]
        return dict(json.loads(lines[-1])) if lines else None

    async def _disturb(self) -> None:
        deeds = (
            self._kill_broker,
            self._freeze_broker,
            self._reload_good,
            self._reload_bad,
            self._command,
            self._command,
        )
        while True:
            await asyncio.sleep(self._draw.uniform(*_BETWEEN_S))
            deed = self._draw.choice(deeds)
            self._tell(deed.__name__.strip("_").replace("_", " "))
            await deed()

    async def _kill_broker(self) -> None:
        pause_s = self._draw.uniform(0.0, 8.0)
        self._did(Cause.BROKER_DEAD, pause_s)
        self._broker.end(signal.SIGKILL)
        await asyncio.sleep(pause_s)
        self._broker.start()

    async def _freeze_broker(self) -> None:
        pause_s = self._draw.uniform(0.5, 8.0)
        self._did(Cause.BROKER_FROZEN, pause_s)
        os.kill(self._broker.pid, signal.SIGSTOP)
        try:
            await asyncio.sleep(pause_s)
        finally:
            os.kill(self._broker.pid, signal.SIGCONT)

    async def _reload_good(self) -> None:
        self._did(Cause.GOOD_FILE, 5.0)
        window_ms = self._draw.choice((10, 20, 50))
        self._config.write_text(self._text + f"[measurement]\nwindow_ms = {window_ms}\n")
        self._daemon_signal(signal.SIGHUP)

    async def _reload_bad(self) -> None:
        self._did(Cause.BAD_FILE, 5.0)
        bad = self._draw.choice(_BAD)
        if bad is None:
            self._config.unlink()
        else:
            self._config.write_text(self._text + bad)
        self._daemon_signal(signal.SIGHUP)
        await asyncio.sleep(2.0)
        await self._reload_good()

    async def _command(self) -> None:
        self._did(Cause.COMMAND, 5.0)
        requests: tuple[tuple[str, dict[str, object]], ...] = (
            ("tare", {}),
            ("mark", {"text": "a long run"}),
            ("set_window", {"window_ms": 20, "step_ms": 5}),
            ("ping", {}),
            ("snapshot", {}),
        )
        self._listener.command(*self._draw.choice(requests))

    def _set_right(self) -> None:
        """Leave no disturbance behind that was cut short."""
        if not self._broker.running:
            self._broker.start()
        self._config.write_text(self._text)

    def _daemon_signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._daemon.pid, number)

    async def _watch(self, seconds: float) -> None:
        """Sample repeatedly; return when the daemon has ended by itself."""
        every_s = min(_SAMPLE_S, seconds / _SAMPLES_MIN)
        await asyncio.sleep(min(10.0, every_s))
        while self._daemon.running:
            held = self._daemon.holdings()
            status = await asyncio.to_thread(self._ask_status)
            await asyncio.to_thread(self._ask_metrics)
            tasks = float(status["health"]["tasks"]) if status and status["health"] else None
            recordings_mb = sum(path.stat().st_size for path in self._recordings()) / 1e6
            over_mb = recordings_mb - _BUDGET_MB - _FLUSHED_MB
            self.seen.recordings_over_mb = max(self.seen.recordings_over_mb, over_mb)
            if tasks is not None and (used := await asyncio.to_thread(self._ask_in_use)) is not None:
                fds, threads = held["file_descriptors"], held["threads"]
                sample = Sample(time.monotonic(), held["rss_mb"], *used, fds, threads, tasks, recordings_mb)
                self.seen.samples.append(sample)
                self._tell(
                    f"{sample.rss_mb:.1f} MB, {used.malloc_mb:.2f} MB and {used.python_blocks} blocks of them in use, "
                    f"{fds:.0f} files, {threads:.0f} threads, {tasks:.0f} tasks"
                )
            if self._listener.health:
                self._take_totals(self._listener.health)
            await asyncio.sleep(every_s)
        self.seen.unexplained.append(f"the daemon ended: {self._daemon.last_log_line()}")

    def _recordings(self) -> list[Path]:
        folder = self._folder / "recordings"
        return list(folder.iterdir()) if folder.exists() else []

    def _ask_status(self) -> dict[str, Any] | None:
        self.seen.asked += 1
        asked = (*_COMMAND, "status", NAME, "--json")
        done = subprocess.run(asked, capture_output=True, text=True, env=os.environ | self._environment, check=False)
        if done.returncode:
            self.seen.refused.append(f"status: {done.returncode}: {done.stderr.strip()}")
            return None
        return dict(json.loads(done.stdout)["daemons"][0])

    def _ask_in_use(self) -> InUse | None:
        self.seen.asked += 1
        used = ask_in_use(self._daemon.pid, Path(self._environment[FILE_VARIABLE]), 5.0)
        if used is None:
            self.seen.refused.append("memory in use: no answer in 5 s")
        return used

    def _ask_metrics(self) -> None:
        self.seen.asked += 1
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._metrics}/metrics", timeout=5.0) as answer:
                if b"resonatord" not in answer.read():
                    self.seen.refused.append("metrics: another text")
        except OSError as error:
            self.seen.refused.append(f"metrics: {error}")

    def _take_totals(self, health: dict[str, Any]) -> None:
        self.seen.spooled_at_end = health["messages"]["spooled"]
        recording = health["recording"]
        self.seen.events_missing = recording["events_missing"]
        self.seen.files, self.seen.files_removed = recording["files"], recording["files_removed"]

    async def _read_log(self) -> None:
        looked_s, waited_s = time.monotonic(), waited_for_cpu_s()
        while True:
            await asyncio.sleep(_LOOK_S)
            now_s, now_waited_s = time.monotonic(), waited_for_cpu_s()
            if now_waited_s - waited_s > _LOADED * (now_s - looked_s) or now_s - looked_s > 2 * _LOOK_S:
                self._did(Cause.LOAD, 0.0)
                self.seen.loaded_s += now_s - looked_s
            looked_s, waited_s = now_s, now_waited_s
            self._take_lines()

    def _take_lines(self) -> None:
        if not self._daemon.log.exists():
            return
        with self._daemon.log.open("rb") as file:
            file.seek(self._read_bytes)
            text = file.read()
        whole, _, _ = text.rpartition(b"\n")
        self._read_bytes += len(whole) + bool(whole)
        for line in new_lines(whole.decode(errors="replace")):
            self.seen.lines += 1
            finding = self.log.unexplained(line, time.monotonic())
            self._tell(f"log: {line}")
            if finding is not None:
                self.seen.unexplained.append(finding)

    def _did(self, cause: Cause, for_s: float) -> None:
        now_s = time.monotonic()
        self.log.did(cause, now_s, now_s + for_s)


def waited_for_cpu_s() -> float:
    """Return how long some process of this computer had to wait for a core, since its start; 0 where nothing tells."""
    try:
        first = Path("/proc/pressure/cpu").read_text().partition("\n")[0]
    except OSError:
        return 0.0
    return int(first.rpartition("total=")[2]) * 1e-6


async def _play_until_stopped(run: Run, seconds: float) -> None:
    playing = asyncio.create_task(run.play(seconds))

    def stop() -> None:
        if run.seen.cut_short:
            playing.cancel()
        run.cut_short()

    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop)
    with contextlib.suppress(asyncio.CancelledError):
        await playing


def _tell_rows(rows: list[Row], seen: Seen, *, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"rows": [row._asdict() for row in rows], "seen": dataclasses.asdict(seen)}))
        return
    for row in rows:
        print(f"{'ok  ' if row.good else 'MISS'} {row.what}: asked {row.asked}; seen {row.seen}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="the table as one object")
    options = parser.parse_args()
    began_s = time.monotonic()

    def tell(text: str) -> None:
        print(f"{time.monotonic() - began_s:8.1f} s  {text}", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder), options.seed, tell)
        try:
            asyncio.run(_play_until_stopped(run, 60.0 * options.minutes))
        finally:
            run.stop()
    rows = judge(run.seen)
    _tell_rows(rows, run.seen, as_json=options.json)
    return 0 if all(row.good for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
