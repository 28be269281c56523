"""How much faster than real time a core emulates plates: quartz16 at 1 kHz with two touches going on, and comb16.

A ratio is that of emulated time to processor time, the best of rounds: what else the machine does slows it.
"""

import time
from typing import Literal

from threadpoolctl import threadpool_limits

from resonator_daemon.plate import load_plate
from simulators.comb_plate import CombPlate
from simulators.plate import EmulatedPlate
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import Scenario
from simulators.scenario_file import Touch

ROUNDS = 40
TOUCHES = [Touch(start_s=0.0, site=site, force_newton=2.0, hold_s=1e6) for site in (4, 7)]


def speed(plate: EmulatedPlate, gate_ticks: int, gate_s: float, frames: int) -> float:
    """Emulated time over processor time, when so many frames are counted at once."""
    at, best_s = round(1.0 / gate_s), float("inf")
    calls = max(1, 80 // frames)
    for _ in range(ROUNDS):
        started = time.process_time()
        for _ in range(calls):
            plate.count(at * gate_ticks, at * gate_ticks, gate_ticks, frames)
            at += frames
        best_s = min(best_s, time.process_time() - started)
    return calls * frames * gate_s / best_s


def quartz(counter: Literal["sums", "stamps"], frames: int) -> float:
    plate = load_plate("quartz16")
    return speed(QuartzPlate(plate, Scenario(TOUCHES, None, plate), 1, counter=counter), 10**6, 1e-3, frames)


def comb(frames: int) -> float:
    plate = load_plate("comb16")
    return speed(CombPlate(plate, Scenario(TOUCHES, None, plate), 1), 1_250_000, 5e-3, frames)


if __name__ == "__main__":
    with threadpool_limits(1):
        print(f"{'':24}{'frames at once':>16}{'x real time':>14}")
        for counter, frames in (("sums", 40), ("sums", 1), ("stamps", 40), ("stamps", 1)):
            print(f"{'quartz16, 1 kHz, ' + counter:24}{frames:16}{quartz(counter, frames):14.1f}")
        for frames in (8, 1):
            print(f"{'comb16, 200 Hz':24}{frames:16}{comb(frames):14.1f}")
