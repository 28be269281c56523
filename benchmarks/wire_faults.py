"""Damage on the wire against what the daemon says of it: every byte in one bin, every lost frame or part reported.

Run it with `python benchmarks/wire_faults.py [SECONDS]`. Exit code 1 when anything disagrees.
"""

import sys
import tempfile
import time
from pathlib import Path
from threading import Event
from typing import Any

from emulated_board import emulated_board

from resonator_daemon.links.table import parse_link
from resonator_daemon.plate import load_plate
from resonator_daemon.session.board_reader import BoardReader
from resonator_daemon.session.counters import LinkCounters
from resonator_daemon.session.frames import Arrival, ChannelisedFrame, LinkChange, SingleToneFrame

CASES = (("quartz16", 1e-5), ("skin32", 1e-7))


def run(plate: str, bit_error_rate: float, seconds: float, folder: Path) -> tuple[LinkCounters, int, dict[str, Any]]:
    """Read a damaged link for some time; return the account, the index of the last frame, and the emulator's report."""
    last_index = -1
    woken = Event()

    def take() -> list[Arrival]:
        nonlocal last_index
        woken.wait(0.5)
        woken.clear()
        arrivals = reader.pop_arrivals()
        for arrival in arrivals:
            if isinstance(arrival, SingleToneFrame | ChannelisedFrame):
                last_index = arrival.index
        return arrivals

    with emulated_board(plate, folder, "--faults", f"bit_error_rate={bit_error_rate:g}") as (link, report):
        reader = BoardReader(parse_link(link), load_plate(plate), woken.set)
        reader.start()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            take()
    while not any(isinstance(arrival, LinkChange) and arrival.state != "online" for arrival in take()):
        pass  # what was still on its way
    reader.stop()
    return reader.counters(), last_index, report


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    disagreements = 0
    for plate, rate in CASES:
        with tempfile.TemporaryDirectory() as folder:
            account, last_index, report = run(plate, rate, seconds, Path(folder))
        fates = {
            "accepted": account.bytes_accepted,
            "other version": account.bytes_other_version,
            "own direction": account.bytes_echo,
            "discarded": account.bytes_discarded,
            "waiting": account.bytes_waiting,
        }
        faults = report["faults"]
        if plate == "quartz16":
            what, reported = "frames", account.lost.total
            injected = sum(sequence < last_index for sequence in faults["frame_sequences_hit"])
        else:
            what, reported, injected = "parts", account.parts_lost, faults["parts_hit"]
        print(
            f"{plate}: one bit in {1 / rate:g} flipped, {account.frames} frames, {faults['bits_flipped']} bits flipped"
        )
        print(f"  bytes in {account.bytes_received} = {sum(fates.values())}: {fates}")
        print(f"  {what} damaged on the wire: {injected}; reported lost: {reported}; frames lost: {account.lost.total}")
        disagreements += account.bytes_received != sum(fates.values())
        disagreements += injected != reported
        disagreements += plate == "skin32" and account.lost.total > 0
    print("all agrees" if not disagreements else f"{disagreements} disagreements")
    return 1 if disagreements else 0


if __name__ == "__main__":
    sys.exit(main())
