"""Processor time of emulated boards at real time, of this checkout and of another one in turns.

Run it with `python benchmarks/emulator_cost.py [--checkout DIR] [--plate NAME]... [--seconds N] [--turns N]`.
`--checkout` names another checkout that has a `.venv` of its own. The host reads every 5 ms and pings once a second, as
the daemon does. Figures are medians of the turns; truth is written to a file, as in the demo.
"""

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from system_parts import child, tree_s

from firmware_protocol.host import Described, Frame, FramePart, HostSession
from firmware_protocol.messages import Configuration
from resonator_daemon.plate import load_plate

ROOT = Path(__file__).resolve().parents[1]
READ_S, PING_S, SETTLE_S = 0.005, 1.0, 1.0
READ_BYTES = 1 << 20


@contextmanager
def opened(link: str) -> Iterator[int]:
    """Give the descriptor of a link, as the emulator prints it."""
    address = link.partition(":")[2].partition("?")[0]
    if link.startswith("tcp:"):
        host, _, port = address.removeprefix("//").rpartition(":")
        with socket.create_connection((host, int(port))) as connection:
            connection.setblocking(False)
            yield connection.fileno()
        return
    descriptor = os.open(address, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(descriptor, termios.TCSANOW)
        yield descriptor
    finally:
        os.close(descriptor)


def read(descriptor: int) -> bytes:
    """Return what can be read now."""
    try:
        return os.read(descriptor, READ_BYTES)
    except BlockingIOError:
        return b""


def start(descriptor: int, gate_ticks: int) -> None:
    """Configure the board and start it; return after the first frame."""
    session = HostSession()
    while True:
        if request := session.data_to_send():
            os.write(descriptor, request)
        time.sleep(READ_S)
        for event in session.receive(read(descriptor)):
            if isinstance(event, Described):
                session.configure(Configuration(gate_ticks))
            if isinstance(event, Frame | FramePart):
                return


def drain(descriptor: int, seconds: float) -> None:
    """Read for that time and discard what is read."""
    session, number = HostSession(), 0
    session.data_to_send()
    until_s = time.monotonic() + seconds
    while (now_s := time.monotonic()) < until_s:
        if now_s > until_s - seconds + number * PING_S:
            number += 1
            session.ping(number.to_bytes(8, "little"))
            os.write(descriptor, session.data_to_send())
        while len(read(descriptor)) == READ_BYTES:
            pass
        time.sleep(READ_S)


def percent_of_a_core(checkout: Path, plate: str, seconds: float) -> float:
    """Run an emulated board; return the processor time that it takes from its second second on."""
    program = str(checkout / ".venv" / "bin" / "resonatord")
    counter = load_plate(plate).counter
    with tempfile.TemporaryDirectory() as folder:
        link = ("--pty", f"{folder}/board") if counter.kind == "single-tone" else ("--tcp", "127.0.0.1:0")
        command = (program, "emulate", "--plate", plate, *link, "--json")
        with child(*command, "--truth", f"{folder}/truth.jsonl", stdout=subprocess.PIPE) as emulator:
            assert emulator.stdout is not None  # noqa: S101 - it is a pipe
            with opened(json.loads(emulator.stdout.readline())["link"]) as descriptor:
                start(descriptor, round(counter.reference_hz / counter.frame_rate_hz))
                drain(descriptor, SETTLE_S)
                before_s, started_s = tree_s(emulator.pid), time.monotonic()
                drain(descriptor, seconds)
                return 100.0 * (tree_s(emulator.pid) - before_s) / (time.monotonic() - started_s)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkout", type=Path, help="another checkout to measure in turns with this one")
    parser.add_argument("--plate", action="append", help="plate to emulate (default: quartz16 and skin32)")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each turn (default: %(default)s)")
    parser.add_argument("--turns", type=int, default=3, help="of each checkout (default: %(default)s)")
    options = parser.parse_args()
    checkouts = [ROOT, *([options.checkout.absolute()] if options.checkout else [])]
    print(f"{'% of a core':12}{'this':>8}{'other':>8}{'ratio':>8}")
    for plate in options.plate or ("quartz16", "skin32"):
        turns = [
            [percent_of_a_core(checkout, plate, options.seconds) for checkout in checkouts]
            for _ in range(options.turns)
        ]
        medians = [statistics.median(each) for each in zip(*turns, strict=True)]
        row = f"{plate:12}" + "".join(f"{median:8.1f}" for median in medians)
        print(row + (f"{medians[0] / medians[1]:8.2f}" if options.checkout else ""), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
