"""How old data is, and what is skipped and lost, while other programs keep the computer busy.

Run it with `python benchmarks/overload.py [--plate quartz16|skin32] [--busy N] [--seconds 30] [--json]`. An emulated
board, Mosquitto and the daemon run next to N processes that compute without end (default: two for each processor). Age
counts from the end of a window's last gate, by the emulator's clock, to the subscriber's callback. Exit code 1 where an
age exceeds the limits, 150 ms for 99 % and 500 ms for all, a frame was lost, a touch was missed or an account does not
balance. `state/link` is to change at most twice, and to name the busy computer within 3 s after these processes have
started, up to 5 s after they have ended; that needs an idle computer.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import cbor2
import numpy as np
from parts import COMMAND, Subscriber, emulated_board, free_port, mosquitto_command, until, write_config

P99_MS, MAX_MS = 150.0, 500.0
SKIPPED = ("skipped_late", "publish_dropped")
AGED = ("forces", "contacts", "decoded")
ONSET_NEWTON, FOUND_WITHIN_NS = 0.02, 50_000_000
SETTLED_S, LAST_S = 10.0, 8.0  # until the board's clock is known; until the busy computer is no longer named
Arrivals = dict[str, list[tuple[int, dict[str, Any]]]]  # UTC in ns and message, by path


def run(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run all processes for a time; return what became of data."""
    truth, port, arrived = folder / "truth.jsonl", free_port(), defaultdict[str, list[tuple[int, bytes]]](list)
    environment = os.environ | {"XDG_STATE_HOME": str(folder), "XDG_RUNTIME_DIR": str(folder), "OMP_NUM_THREADS": "1"}
    with ExitStack() as stack:
        log = stack.enter_context((folder / "log").open("w"))

        def start(*command: str) -> None:
            # Sessions of their own, as of programs that have nothing to do with each other.
            process = subprocess.Popen(command, env=environment, stderr=log, start_new_session=True)
            stack.callback(process.wait)
            stack.callback(process.terminate)

        start(*mosquitto_command(port, folder))
        board = stack.enter_context(emulated_board(options.plate, folder, "--truth", str(truth)))
        config = write_config(folder, options.plate, board.link, port)
        paths = (*AGED, "contacts/event", "health", "state/link")
        subscriber = Subscriber(port, paths, lambda path, payload, at_ns: arrived[path].append((at_ns, payload)))
        stack.callback(subscriber.close)
        start(*COMMAND, "run", "--config", str(config))
        until(lambda: "contacts" in arrived, "a message on contacts")
        time.sleep(SETTLED_S)
        begin_ns = time.time_ns()
        with ExitStack() as busy:
            for _ in range(options.busy):
                spinning = subprocess.Popen([sys.executable, "-c", "while True: pass"], start_new_session=True)
                busy.callback(spinning.wait)
                busy.callback(spinning.kill)
            time.sleep(options.seconds)
            end_ns = time.time_ns()
        time.sleep(LAST_S)
    read = {path: [(at_ns, fields_of(payload)) for at_ns, payload in found] for path, found in arrived.items()}
    log_lines = [line for line in (folder / "log").read_text().splitlines() if "WARNING" in line or "ERROR" in line]
    return outcome(read, truth, begin_ns, end_ns) | {
        "dropped_by_board": board.report["frames_dropped"],
        "log": log_lines,
    }


def fields_of(payload: bytes) -> dict[str, Any]:
    fields: dict[str, Any] = json.loads(payload) if payload.startswith(b"{") else cbor2.loads(payload)
    return fields


def read_truth(file: Path) -> tuple[dict[int, int], dict[int, tuple[int, int | None]]]:
    """Return the ends of gates by board ticks, and when and where each touch crossed the force of an onset."""
    gate_end_ns: dict[int, int] = {}
    touches: dict[int, tuple[int, int | None]] = {}
    for text in file.read_text().splitlines():
        line = json.loads(text)
        at_ns = gate_end_ns[line["board_ticks"]] = int(line["t_ns"])
        for contact in line["contacts"]:
            if contact["force_newton"][2] >= ONSET_NEWTON:
                touches.setdefault(contact["id"], (at_ns, contact["site"]))
    return gate_end_ns, touches


def outcome(arrivals: Arrivals, truth: Path, begin_ns: int, end_ns: int) -> dict[str, Any]:
    """Compare what arrived in a time, UTC, with the emulator's truth."""
    gate_end_ns, touches = read_truth(truth)
    ages: dict[str, Any] = {}
    uncounted = 0
    for path in AGED:
        messages = arrivals.get(path, [])
        during = [each for each in messages if begin_ns <= each[0] <= end_ns]
        if during:
            aged_ms = [(at_ns - gate_end_ns[int(fields["board_ticks"])]) / 1e6 for at_ns, fields in during]
            p50, p99 = np.percentile(aged_ms, [50, 99])
            figures = {"p50": p50, "p99": p99, "max": max(aged_ms)}
            ages[path] = {"messages": len(aged_ms)} | {name: round(float(age), 1) for name, age in figures.items()}
        for (_, before), (_, after) in pairwise(messages):
            counted = sum(after["lost"].get(key, 0) - before["lost"].get(key, 0) for key in SKIPPED)
            uncounted += after["seq"] - before["seq"] - 1 > counted
    events = [event for _, event in arrivals.get("contacts/event", [])]
    onsets = [(int(e["contact"]["since_t_ns"]), e["contact"]["site"]) for e in events if e["event"] == "onset"]
    true = [touch for touch in touches.values() if begin_ns < touch[0] < end_ns]
    found = sum(
        any(abs(since_ns - at_ns) < FOUND_WITHIN_NS and site in (None, seen) for since_ns, seen in onsets)
        for at_ns, site in true
    )
    numbers = [event["seq"] for event in events]
    health = [fields for at_ns, fields in arrivals["health"] if at_ns >= begin_ns]
    first, last, account = health[0], health[-1], health[-1]["messages"]
    known = ("acknowledged", "written", "unknown_at_disconnect", "waiting")
    links = [(at_ns, fields["reason_code"] == "computer_busy") for at_ns, fields in arrivals.get("state/link", [])]
    stated_s = [(at_ns - begin_ns) / 1e9 for at_ns, is_busy in links if is_busy and at_ns >= begin_ns]
    withdrawn_s = [(at_ns - end_ns) / 1e9 for at_ns, is_busy in links if not is_busy and at_ns > end_ns]
    return {
        "age_ms": ages,
        "lost": {cause: count - first["lost"].get(cause, 0) for cause, count in last["lost"].items()},  # without zeros
        "frames_not_decoded": last["frames_not_decoded"] - first["frames_not_decoded"],
        "touches": len(true),
        "missed": len(true) - found,
        "link_changes": sum(begin_ns <= at_ns <= end_ns for at_ns, _ in links),
        "busy_before": any([is_busy for at_ns, is_busy in links if at_ns < begin_ns][-1:]),
        "busy_stated_s": next(iter(stated_s), None),
        "busy_withdrawn_s": next(iter(withdrawn_s), None),
        "events_in_order": all(after == before + 1 for before, after in pairwise(numbers)),
        "gaps_not_counted": uncounted,
        "account_off": account["enqueued"] - sum(account["dropped"].values()) - sum(account[key] for key in known),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plate", default="quartz16")
    parser.add_argument("--busy", type=int, default=2 * (os.cpu_count() or 1))
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = run(options, Path(folder))
    if options.json:
        print(json.dumps(found))
    else:
        print(f"{options.plate} next to {options.busy} busy processes for {options.seconds:g} s")
        for key, value in found.items():
            print(f"  {key}: {value}")
    old = any(age["p99"] > P99_MS or age["max"] > MAX_MS for age in found["age_ms"].values())
    frames = sum(count for cause, count in found["lost"].items() if cause not in SKIPPED)
    wrong = found["missed"] or found["gaps_not_counted"] or found["account_off"] or not found["events_in_order"]
    late = [
        seconds is None or seconds > limit_s
        for seconds, limit_s in ((found["busy_stated_s"], 3.0), (found["busy_withdrawn_s"], 5.0))
    ]
    return int(bool(old or frames or wrong or any(late) or found["link_changes"] > 2))


if __name__ == "__main__":
    sys.exit(main())
