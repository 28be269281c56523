"""What a daemon leaks, loses and miscounts over a long time under faults of everything around it.

Run it with `make soak MINUTES=60`, or `python benchmarks/long_run.py --minutes N [--seed N] [--json]`; seven days are
10080 minutes. `resonatord run` is a process of its own, with continuous recording in a small budget and the status
socket; so are an emulated board whose faults change every minute and a Mosquitto that dies and stands still.
Ctrl-C ends it early, in order and with the table of what was seen until then. Exit code 1 when a figure is missed or
the run was cut short. The daemon tells on SIGUSR1 what memory is in use: what an allocator keeps is no leak.
"""

import argparse
import contextlib
import ctypes
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from long_run_judge import Seen, account_off, judge, leg_of, print_rows
from parts import COMMAND, NAME, Part, Subscriber, free_port, mosquitto_command, own_directories

FILE_VARIABLE: Final = "MEMORY_IN_USE_FILE"
SAMPLE_S: Final = 30.0
SAMPLES_MIN: Final = 40  # of a short run
LEG_S: Final = (20.0, 90.0)  # of a board
BETWEEN_S: Final = (5.0, 30.0)  # disturbances besides the board's
GONE_S: Final = (0.2, 3.0)  # without a board, from one leg to the next
SETTLED_S: Final = 12.0  # at the end, with a board and a broker in order
BUDGET_MB, FILE_MB = 16, 4
FLUSHED_MB: Final = 2.0  # what the writer holds before it looks at the budget
EXCUSED_S: Final = 20.0  # after the broker died or stood still, which loses what it had
KEPT: Final = 50  # findings; a run that goes wrong all the time is no better known by more
BAD: Final = ("plate = ", "[measurement]\nwindow_ms = -1\n", "[commands]\nallow = [7]\n", "\x00")
REQUESTS: Final = (("tare", {}), ("mark", {"text": "a long run"}), ("set_window", {"window_ms": 20, "step_ms": 5}))
# `rate` is between 0.1 and 1 a second, `at` within the leg, `short` up to 4 s.
FAULTS: Final = (
    *("bit_error_rate={rate}e-5", "burst_rate_hz={rate}", "garbage_rate_hz={rate}"),
    *("lost_chunk_rate_hz={rate},lost_chunk_bytes=900", "duplicate_rate=1e-3", "clump_ms=16"),
    *("answer_delay_rate=0.5,answer_delay_ms=100", "frame_delay_rate=0.01", "slow_reader_bytes_per_s=180000"),
    *("unplug_rate_hz=0.05,unplug_for_s={short}", "unplug_at_s={at},unplug_for_s={short}"),
    *("freeze_at_s={at},freeze_for_s={short}", "silence_at_s={at},silence_for_s={short}", "reboot_at_s={at}"),
    *("brown_out_at_s={at}", "tick_step_at_s={at},tick_step_ticks=250000000"),
    *("wrong_board_at_s={at},wrong_board_for_s={short}",),
)


class Listener:
    """Judges each message as it comes, through restarts of the broker."""

    def __init__(self, port: int, seen: Seen) -> None:
        self._seen = seen
        self._last: dict[str, tuple[str, int, int]] = {}  # run, seq, and what was not sent
        self._news = threading.Condition()
        self.health: dict[str, Any] = {}
        self.excused_until_s = 0.0
        self.subscriber = Subscriber(port, ("forces", "contacts/event", "health"), self._take)

    def next_health(self, timeout_s: float) -> dict[str, Any] | None:
        """Wait for a message of `health` that is made from now on; None where none comes."""
        with self._news:
            wanted = self._seen.healths + 2  # the next one may have been on its way already
            return self.health if self._news.wait_for(lambda: self._seen.healths >= wanted, timeout_s) else None

    def _take(self, path: str, payload: bytes, _at_ns: int) -> None:
        message, seen = json.loads(payload), self._seen
        if path == "health":
            with self._news:
                self.health = message
                seen.healths += 1
                seen.accounts_off += account_off(message) if len(seen.accounts_off) < KEPT else []
                self._news.notify_all()
            return
        lost, seq = message["lost"], message["seq"]
        unsent = lost.get("publish_dropped", 0) + lost.get("skipped_late", 0)
        run, last, last_unsent = self._last.get(path, ("", 0, 0))
        seen.messages += 1
        if run == message["daemon_boot_id"] and seq <= last:
            seen.out_of_order += not message.get("replayed", False)
            return
        self._last[path] = (message["daemon_boot_id"], seq, unsent)
        if run == message["daemon_boot_id"] and time.monotonic() > self.excused_until_s:
            seen.holes += max(0, seq - last - 1 - max(0, unsent - last_unsent))


class Run:
    """Everything that runs, and what was seen of it."""

    def __init__(self, folder: Path, seed: int, tell: Callable[[str], None]) -> None:
        self.seen, self.over = Seen(), threading.Event()
        self._folder, self._tell, self._draw = folder, tell, random.Random(seed)
        port = free_port()
        self._config, self._terminal = folder / "board.toml", folder / "port"
        self._text = (
            f'name = "{NAME}"\nplate = "quartz16"\nlink = "serial:{self._terminal}?baud=4000000"\n'
            f'[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
            '[commands]\nallow = ["tare", "mark", "set_window", "start_recording", "stop_recording"]\n'
            f'[recording]\nautostart = true\ninclude_messages = true\ndirectory = "{folder / "recordings"}"\n'
            f"file_max_mb = {FILE_MB}\nfile_max_minutes = 2\nmax_total_mb = {BUDGET_MB}\nmin_free_mb = 10\n"
        )
        self._config.write_text(self._text)
        (folder / "run").mkdir(mode=0o700)
        self._in_use = folder / "in_use.json"
        self._environment = own_directories(folder)
        self._environment |= {"XDG_RUNTIME_DIR": str(folder / "run"), FILE_VARIABLE: str(self._in_use)}
        self._board = self._make_board("")
        broker = mosquitto_command(port, folder, "max_queued_messages 0", "log_dest none")
        self._broker = Part("broker", broker, folder / "broker.log", self._environment)
        watched = (sys.executable, __file__, "--watched", "run", "--config", str(self._config))
        self._daemon = Part("daemon", watched, folder / "daemon.log", self._environment)
        self._listener = Listener(port, self.seen)

    def play(self, seconds: float) -> None:
        """Run for so long, or until `over` is set; then end all in order and take the last figures."""
        self._broker.start()
        self._daemon.start()
        began_s = time.monotonic()
        works = [threading.Thread(target=work, args=(seconds,)) for work in (self._change_boards, self._watch)]
        for thread in works:
            thread.start()
        while not self.over.wait(min(self._draw.uniform(*BETWEEN_S), max(0.0, began_s + seconds - time.monotonic()))):
            if time.monotonic() >= began_s + seconds or not self._daemon.running:
                break
            self._disturb()
        self.seen.cut_short = self.over.is_set()
        self.seen.asked_s, self.seen.ran_s = seconds, time.monotonic() - began_s
        self.over.set()  # the last board ends in order, and is judged by what it had sent
        for thread in works:
            thread.join()
        self._start_board("")
        time.sleep(SETTLED_S)
        self.seen.recording = (self._listener.next_health(5.0) or {}).get("recording", {})
        if self._daemon.end(signal.SIGTERM) and self._daemon.process is not None:
            self.seen.exit_code = self._daemon.process.returncode
        log = self._daemon.log.read_text(errors="replace").splitlines()
        self.seen.tracebacks = [line for line in log if "Traceback" in line]

    def stop(self) -> None:
        """Kill whatever still runs."""
        self._listener.subscriber.close()
        for part in (self._daemon, self._board, self._broker):
            if part.running:
                part.end(signal.SIGKILL)

    def _change_boards(self, _seconds: float) -> None:
        before = self._listener.next_health(20.0)
        while not self.over.is_set():
            seconds = self._draw.uniform(*LEG_S)
            at, rate = round(self._draw.uniform(3.0, seconds - 8.0), 2), round(10 ** self._draw.uniform(-1.0, 0.0), 3)
            drawn = self._draw.sample(FAULTS, self._draw.choice((0, 1, 1, 2, 3)))
            if any("slow_reader" in each for each in drawn):  # the emulator does not count what both hold back
                drawn = [each for each in drawn if "clump" not in each]
            short = round(self._draw.uniform(0.3, 4.0), 2)
            faults = ",".join(each.format(at=at, rate=rate, short=short) for each in drawn)
            self._start_board(faults)
            self._tell(f"board for {seconds:.0f} s: {faults or 'no faults'}")
            is_over = self.over.wait(seconds)
            is_killed = not is_over and self._draw.random() < 0.15
            self._board.end(signal.SIGKILL if is_killed else signal.SIGINT)
            time.sleep(self._draw.uniform(*GONE_S))
            after = self._listener.next_health(10.0)
            lines = [line for line in self._board.log.read_text().splitlines() if line.startswith('{"frames_made')]
            if before is not None and after is not None and lines:
                leg = leg_of(faults or "no faults", json.loads(lines[-1]), before, after)
                self.seen.legs.append(leg)
                self._tell(f"{leg.missing} whole frames missing of {leg.sent}, at most {leg.excused}")
            before = after

    def _make_board(self, faults: str) -> Part:
        board = (*COMMAND, "emulate", "--plate", "quartz16", "--pty", str(self._terminal), "--json")
        command = (*board, "--seed", str(self._draw.randrange(2**31)), *(("--faults", faults) if faults else ()))
        return Part("board", command, self._folder / "board.log", self._environment, leftover=self._terminal)

    def _start_board(self, faults: str) -> None:
        self._board.log.unlink(missing_ok=True)
        self._board = self._make_board(faults)
        self._board.start()

    def _disturb(self) -> None:
        """Kill or freeze the broker, read a good or a bad configuration again, or send a command."""
        what = self._draw.choice(("kill broker", "freeze broker", "reload", "bad configuration", "command", "command"))
        self._tell(what)
        pause_s = self._draw.uniform(0.5, 8.0)
        if "broker" in what:
            self._listener.excused_until_s = time.monotonic() + pause_s + EXCUSED_S
            if what.startswith("kill"):
                self._broker.end(signal.SIGKILL)
                time.sleep(pause_s)
                self._broker.start()
            else:
                os.kill(self._broker.pid, signal.SIGSTOP)
                time.sleep(pause_s)
                os.kill(self._broker.pid, signal.SIGCONT)
        elif what == "command":
            verb, request = self._draw.choice(REQUESTS)
            self._listener.subscriber.publish(f"cmd/{verb}", dict(request))
        else:
            if what.startswith("bad"):
                self._reload(self._draw.choice(BAD))
                time.sleep(2.0)
            self._reload(f"[measurement]\nwindow_ms = {self._draw.choice((10, 20, 50))}\n")

    def _reload(self, tables: str) -> None:
        self._config.write_text(self._text + tables)
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._daemon.pid, signal.SIGHUP)

    def _watch(self, seconds: float) -> None:
        """Sample repeatedly, until it is over or the daemon has ended by itself."""
        every_s, seen = min(SAMPLE_S, seconds / SAMPLES_MIN), self.seen
        time.sleep(min(10.0, every_s))
        while self._daemon.running and not self.over.wait(every_s):
            status, used = self._ask_status(), self._ask_in_use()
            recordings = self._folder / "recordings"
            files = list(recordings.iterdir()) if recordings.exists() else []
            over_mb = sum(path.stat().st_size for path in files if path.exists()) / 1e6 - BUDGET_MB - FLUSHED_MB
            seen.recordings_over_mb = max(seen.recordings_over_mb, over_mb)
            if status and status["health"] and used:
                tasks = {"at_s": time.monotonic(), "tasks": float(status["health"]["tasks"])}
                seen.samples.append(tasks | self._daemon.holdings() | used)
                self._tell(
                    ", ".join(f"{name} {value:.2f}" for name, value in seen.samples[-1].items() if name != "at_s")
                )
        if not self._daemon.running:
            seen.refused.append(f"the daemon ended: {self._daemon.last_log_line()}")

    def _ask_status(self) -> dict[str, Any] | None:
        self.seen.asked += 1
        asked = (*COMMAND, "status", NAME, "--json")
        done = subprocess.run(asked, capture_output=True, text=True, env=os.environ | self._environment, check=False)
        if done.returncode:
            self.seen.refused.append(f"status: {done.returncode}: {done.stderr.strip()}")
            return None
        return dict(json.loads(done.stdout)["daemons"][0])

    def _ask_in_use(self) -> dict[str, float]:
        self._in_use.unlink(missing_ok=True)
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._daemon.pid, signal.SIGUSR1)
        until_s = time.monotonic() + 5.0
        while time.monotonic() < until_s:
            if self._in_use.exists():
                return dict(json.loads(self._in_use.read_text()))
            time.sleep(0.01)
        self.seen.refused.append("memory in use: no answer in 5 s")
        return {}


class _Mallinfo2(ctypes.Structure):
    _names = ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    _fields_ = tuple((name, ctypes.c_size_t) for name in _names)


def watched(arguments: list[str]) -> int:
    """Run `resonatord`; on SIGUSR1 write what malloc has in use, and the blocks that Python divides itself."""

    def tell(*_: object) -> None:
        libc = ctypes.CDLL(None)
        libc.mallinfo2.restype = _Mallinfo2
        info, path = libc.mallinfo2(), Path(os.environ[FILE_VARIABLE])
        used = {"malloc_mb": (info.uordblks + info.hblkhd) / 2**20, "blocks_thousand": sys.getallocatedblocks() / 1e3}
        fresh = path.with_suffix(".fresh")
        fresh.write_text(json.dumps(used))
        fresh.replace(path)

    signal.signal(signal.SIGUSR1, tell)
    from resonator_daemon.commands import main as resonatord

    sys.argv[1:] = arguments
    return resonatord()


def main() -> int:
    if sys.argv[1:2] == ["--watched"]:
        return watched(sys.argv[2:])
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
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: run.over.set())
        try:
            run.play(60.0 * options.minutes)
        finally:
            run.stop()
    return print_rows(judge(run.seen), as_json=options.json)


if __name__ == "__main__":
    sys.exit(main())
