"""Age of what a subscriber receives while other programs keep the computer busy, and what was skipped for it.

Run it with `python benchmarks/overload.py [--plate quartz16|skin32] [--busy N] [--seconds 30] [--nice N] [--real-time]
[--own-core] [--json]`.
An emulated board, Mosquitto and the daemon run as processes of their own, next to N processes that compute without end
(default: two for each processor). Age counts from the end of a window's last gate, by the emulator's clock, to the
subscriber's callback. Exit code 1 where an age exceeds the limits, 150 ms for 99 % and 500 ms for all, a frame was
lost, a touch was missed or an account does not balance. `state/link` is to change at most twice, and to name the busy
computer within 3 s after these processes have started, up to 5 s after they have ended; that needs an idle computer.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from emulated_board import emulated_board
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion
from system_parts import free_port, mosquitto_command

from resonator_daemon.publishing.codec import decode
from resonator_daemon.publishing.payloads import Decoded, MessageAccount

P99_MS, MAX_MS = 150.0, 500.0
AGED = ("forces", "contacts", "decoded")
ONSET_NEWTON = 0.02
FOUND_WITHIN_NS = 50_000_000
_SETTLED_S = 10.0  # the board's clock is known
_FIRST_S = 120.0
_AFTER_S = 8.0  # in which the busy computer is no longer named
_REAL_TIME_PRIORITY = 10
_SPIN = "while True: pass"


class Subscriber:
    """Keeps what arrives and when; reads nothing meanwhile."""

    def __init__(self, port: int, name: str) -> None:
        self.arrivals: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
        self.first = threading.Event()
        self._base = f"resonator/{name}/"
        self._client = Client(CallbackAPIVersion.VERSION2, protocol=5)
        self._client.on_message = self._take
        self._client.connect("127.0.0.1", port)
        for path in (*AGED, "contacts/event", "health", "state/link"):
            self._client.subscribe(self._base + path, qos=1)
        self._client.loop_start()

    def _take(self, _client: object, _userdata: object, message: Any) -> None:
        now_ns = time.time_ns()
        path = message.topic.removeprefix(self._base)
        self.arrivals[path].append((now_ns, message.payload))
        if path == "contacts":
            self.first.set()

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


def fields_of(path: str, payload: bytes) -> dict[str, Any]:
    """Return the keys of a message."""
    if path == "decoded":
        message = decode(Decoded, payload)
        return {"seq": message.seq, "board_ticks": message.board_ticks, "lost": message.lost.model_dump()}
    fields: dict[str, Any] = json.loads(payload)
    return fields


@dataclass(frozen=True)
class Share:
    """What the daemon is given of the processors."""

    niceness: int = 0
    real_time: bool = False
    own_core: bool = False

    def give(self, pid: int) -> None:
        """Give it to all threads of a process, and to its session where the kernel shares out by sessions."""
        for thread in map(int, os.listdir(f"/proc/{pid}/task")):
            if self.niceness:
                os.setpriority(os.PRIO_PROCESS, thread, self.niceness)
            if self.real_time:
                os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(_REAL_TIME_PRIORITY))
            if self.own_core:
                os.sched_setaffinity(thread, {max(os.sched_getaffinity(0))})
        if self.niceness:
            with suppress(OSError):
                Path(f"/proc/{pid}/autogroup").write_text(str(self.niceness))

    def leave(self, pid: int) -> None:
        """Keep another process off the daemon's core."""
        if self.own_core:
            os.sched_setaffinity(pid, os.sched_getaffinity(0) - {max(os.sched_getaffinity(0))})


def run(plate: str, busy: int, seconds: float, share: Share, folder: Path) -> dict[str, Any]:
    """Run all processes for a time; return the result as keys of its JSON object."""
    truth, port, config = folder / "truth.jsonl", free_port(), folder / "bench.toml"
    environment = os.environ | {"XDG_STATE_HOME": str(folder), "XDG_RUNTIME_DIR": str(folder), "OMP_NUM_THREADS": "1"}
    with ExitStack() as stack:

        def start(*command: str) -> int:
            # Sessions of their own, as of programs that have nothing to do with each other.
            process = subprocess.Popen(command, env=environment, stderr=log, start_new_session=True)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process.pid

        log = stack.enter_context((folder / "log").open("w"))
        start(*mosquitto_command(port, folder))
        link, report = stack.enter_context(emulated_board(plate, folder, "--truth", str(truth)))
        config.write_text(
            f'name = "bench"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
        )
        time.sleep(0.5)
        subscriber = Subscriber(port, "bench")
        stack.callback(subscriber.close)
        daemon = start(sys.executable, "-m", "resonator_daemon", "run", "--config", str(config))
        if not subscriber.first.wait(_FIRST_S):
            raise SystemExit(f"no message within {_FIRST_S:g} s: {(folder / 'log').read_text()}")
        time.sleep(_SETTLED_S)
        share.give(daemon)
        begin_ns = time.time_ns()
        spinning = [subprocess.Popen([sys.executable, "-c", _SPIN], start_new_session=True) for _ in range(busy)]
        for process in spinning:
            share.leave(process.pid)
        time.sleep(seconds)
        end_ns = time.time_ns()
        for process in spinning:
            process.kill()
            process.wait()
        time.sleep(_AFTER_S)
    return outcome(subscriber, truth, begin_ns, end_ns, report) | {"log": (folder / "log").read_text().splitlines()}


def outcome(subscriber: Subscriber, truth: Path, begin_ns: int, end_ns: int, report: dict[str, Any]) -> dict[str, Any]:
    """Compare what arrived from `begin_ns` to `end_ns`, UTC, with the emulator's truth."""
    gate_end_ns: dict[int, int] = {}
    touches: dict[int, tuple[int, int | None]] = {}
    for text in truth.read_text().splitlines():
        line = json.loads(text)
        at_ns = gate_end_ns[line["board_ticks"]] = int(line["t_ns"])
        for contact in line["contacts"]:
            if contact["force_newton"][2] >= ONSET_NEWTON:
                touches.setdefault(contact["id"], (at_ns, contact["site"]))
    ages: dict[str, Any] = {}
    uncounted = 0
    for path in AGED:
        messages = [(at_ns, fields_of(path, payload)) for at_ns, payload in subscriber.arrivals[path]]
        during = [(at_ns, fields) for at_ns, fields in messages if begin_ns <= at_ns <= end_ns]
        aged_ms = [(at_ns - gate_end_ns[int(fields["board_ticks"])]) / 1e6 for at_ns, fields in during]
        if aged_ms:
            p50, p99 = np.percentile(aged_ms, [50, 99])
            ages[path] = {"messages": len(aged_ms), "p50": p50, "p99": p99, "max": max(aged_ms)}
        for (_, before), (_, after) in pairwise(messages):
            missing = after["seq"] - before["seq"] - 1
            counted = sum(
                after["lost"].get(key, 0) - before["lost"].get(key, 0) for key in ("skipped_late", "publish_dropped")
            )
            uncounted += missing > counted
    events = [json.loads(payload) for _, payload in subscriber.arrivals["contacts/event"]]
    onsets = [
        (int(event["contact"]["since_t_ns"]), event["contact"]["site"]) for event in events if event["event"] == "onset"
    ]
    true = [touch for touch in touches.values() if begin_ns < touch[0] < end_ns]
    found = sum(
        any(abs(since_ns - at_ns) < FOUND_WITHIN_NS and site in (None, seen) for since_ns, seen in onsets)
        for at_ns, site in true
    )
    numbers = [event["seq"] for event in events]
    health = [json.loads(payload) for at_ns, payload in subscriber.arrivals["health"] if at_ns >= begin_ns]
    links = [(at_ns, json.loads(payload)["reason_code"]) for at_ns, payload in subscriber.arrivals["state/link"]]
    load_s, busy = (end_ns - begin_ns) / 1e9, [((t - begin_ns) / 1e9, code == "computer_busy") for t, code in links]
    first, last = health[0]["lost"], health[-1]["lost"]
    lost = {cause: count - first.get(cause, 0) for cause, count in last.items()}
    not_decoded = health[-1]["frames_not_decoded"] - health[0]["frames_not_decoded"]
    account = MessageAccount.model_validate(health[-1]["messages"])
    settled = account.acknowledged + account.written + sum(account.dropped.values())
    return {
        "age_ms": ages,
        "lost": lost,
        "frames_not_decoded": not_decoded,
        "dropped": account.dropped,
        "dropped_by_board": report["frames_dropped"],
        "touches": len(true),
        "missed": len(true) - found,
        "link_changes": sum(begin_ns <= at_ns <= end_ns for at_ns, _ in links),
        "busy_before": any([is_busy for at_s, is_busy in busy if at_s < 0][-1:]),
        "busy_stated_s": next((at_s for at_s, is_busy in busy if is_busy and at_s >= 0), None),
        "busy_withdrawn_s": next((at_s - load_s for at_s, is_busy in busy if not is_busy and at_s > load_s), None),
        "events_in_order": numbers == list(range(numbers[0], numbers[0] + len(numbers))) if numbers else True,
        "gaps_not_counted": uncounted,
        "account_off": account.enqueued - settled - account.unknown_at_disconnect - account.waiting,
    }


def main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--plate", default="quartz16")
    options.add_argument("--busy", type=int, default=2 * (os.cpu_count() or 1))
    options.add_argument("--seconds", type=float, default=30.0)
    options.add_argument("--nice", type=int, default=0, help="niceness of the daemon")
    options.add_argument("--real-time", action="store_true", help="the daemon under SCHED_RR")
    options.add_argument("--own-core", action="store_true", help="the last processor for the daemon alone")
    options.add_argument("--json", action="store_true")
    chosen = options.parse_args()
    share = Share(chosen.nice, chosen.real_time, chosen.own_core)
    with tempfile.TemporaryDirectory() as folder:
        found = run(chosen.plate, chosen.busy, chosen.seconds, share, Path(folder))
    log = found.pop("log")
    if chosen.json:
        print(json.dumps(found))
    else:
        print(f"{chosen.plate} next to {chosen.busy} busy processes for {chosen.seconds:g} s, {share}")
        for path, age in found["age_ms"].items():
            figures = ", ".join(f"{key} {age[key]:.1f}" for key in ("p50", "p99", "max"))
            print(f"  {path:9s} {age['messages']:6d} messages, age in ms: {figures}")
        print(*(f"  {key}: {value}" for key, value in found.items() if key != "age_ms"), sep="\n")
        print(*(f"  log: {line}" for line in log if "WARNING" in line or "ERROR" in line), sep="\n")
    old = any(age["p99"] > P99_MS or age["max"] > MAX_MS for age in found["age_ms"].values())
    frames = sum(count for cause, count in found["lost"].items() if cause not in ("publish_dropped", "skipped_late"))
    wrong = found["missed"] or found["gaps_not_counted"] or found["account_off"] or not found["events_in_order"]
    stated_s, withdrawn_s = found["busy_stated_s"], found["busy_withdrawn_s"]
    unnamed = found["link_changes"] > 2 or not 0 <= (stated_s or -1) <= 3 or not 0 <= (withdrawn_s or -1) <= 5
    return int(bool(old or frames or wrong or unnamed))


if __name__ == "__main__":
    sys.exit(main())
