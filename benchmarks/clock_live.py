"""The board's clock over a real pseudo-terminal: times of frames against the emulator's truth, in two processes.

Run it with `python benchmarks/clock_live.py [RUNS]`. Exit code 1 when a figure is missed: after five s
at most 200 us rms, and at most three times what is stated for 99 % of the frames.
"""

import json
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
from emulated_board import emulated_board

from resonator_daemon.links.table import parse_link
from resonator_daemon.plate import load_plate
from resonator_daemon.session.board_reader import BoardReader
from resonator_daemon.session.frames import SingleToneFrame

LINKS = (
    ("plain", "skew_ppm=50"),
    ("16 ms batches, 1 % of answers 50 ms late", "clump_ms=16,answer_delay_rate=0.01,answer_delay_ms=50,skew_ppm=50"),
    ("the same, slow crystal", "clump_ms=16,answer_delay_rate=0.01,answer_delay_ms=50,skew_ppm=-50"),
)
FRAMES, SETTLED = 20_000, 5_000  # of one a millisecond
RMS_LIMIT_US, INSIDE_LIMIT = 200.0, 0.99
HALF_GATE_NS = 500_000


def play(faults: str) -> tuple[np.ndarray, np.ndarray]:
    """Return error and stated bound of each frame's time, in us."""
    plate = load_plate("quartz16")
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder) / "truth.jsonl"
        options = ("--faults", faults, "--truth", str(truth))
        with emulated_board("quartz16", Path(folder), *options) as (link, _):
            woken, frames = threading.Event(), []
            reader = BoardReader(parse_link(link), plate, woken.set, step_frames=(5,))
            reader.start()
            while len(frames) < FRAMES:
                woken.wait(1.0)
                woken.clear()
                frames += [arrival for arrival in reader.pop_arrivals() if isinstance(arrival, SingleToneFrame)]
            reader.stop()
        lines = map(json.loads, truth.read_text().splitlines())
        ends_ns = {line["board_ticks"]: int(line["t_ns"]) for line in lines}
    times = [(frame.gate_middle, ends_ns[frame.board_ticks]) for frame in frames]
    errors_ns = [middle.utc_ns + HALF_GATE_NS - end_ns for middle, end_ns in times]
    return np.array(errors_ns) / 1e3, np.array([middle.uncertainty_ns for middle, _ in times]) / 1e3


def main() -> int:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    missed = 0
    print("| link | rms us, 2 to 5 s | rms us after 5 s | p99 us | t_unc us | within 3 t_unc |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, faults in LINKS * runs:
        errors, bounds = play(faults)
        early, late, bound = errors[2000:SETTLED], errors[SETTLED:], bounds[SETTLED:]
        rms, inside = float(np.sqrt(np.mean(late**2))), float(np.mean(np.abs(late) <= 3 * bound))
        print(
            f"| {name} | {np.sqrt(np.mean(early**2)):.0f} | {rms:.0f} | {np.quantile(np.abs(late), 0.99):.0f} | "
            f"{np.median(bound):.0f} | {inside:.2%} |",
            flush=True,
        )
        missed += rms > RMS_LIMIT_US or inside < INSIDE_LIMIT
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
