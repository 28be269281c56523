"""Oscillator noise of the emulator as allantools sees it, and what a plate's physics costs.

Table 1: overlapping Allan deviation over its nominal value by averaging time, and the slope, for each type of noise and
for the defaults together. Table 2: time for the physics of quartz16 as a share of the time that the frames stand for.
Run it with `python benchmarks/emulator_noise.py`; it takes a minute.
"""

import math
import time

import allantools
import numpy as np

from resonator_daemon.plate import load_plate
from simulators.oscillator_noise import OscillatorNoise
from simulators.physics import Physics
from simulators.site_physics import SitePhysics

OSCILLATORS = 64
TYPES = {
    "white": (3e-10, 0.0, 0.0, -0.5),
    "flicker": (0.0, 1e-10, 0.0, 0.0),
    "random walk": (0.0, 0.0, 2e-12, 0.5),
    "defaults": (3e-10, 1e-10, 2e-12, math.nan),
}
SPANS = (1, 3, 10, 30, 100, 300, 1000, 3000)
GATES = 2**16


def allan_table(dt_s: float) -> None:
    tau_s = np.array(SPANS) * dt_s
    print(f"gates of {dt_s:g} s, {GATES} of them, {OSCILLATORS} oscillators: deviation / nominal")
    print(f"{'averaging time, s':<20}" + "".join(f"{tau:>9.3g}" for tau in tau_s) + f"{'slope':>9}{'nominal':>9}")
    for name, (white, flicker, walk, slope) in TYPES.items():
        noise = OscillatorNoise(OSCILLATORS, white, flicker, walk, np.random.default_rng(1))
        shift = np.concatenate([noise.advance(dt_s, GATES // 16).relative_shift for _ in range(16)])
        variance = np.mean(
            [allantools.oadev(y, 1 / dt_s, data_type="freq", taus=tau_s)[1] ** 2 for y in shift.T], axis=0
        )
        nominal = np.sqrt(white**2 / tau_s + flicker**2 + walk**2 * tau_s)
        fitted = np.polyfit(np.log(tau_s), np.log(variance) / 2, 1)[0]
        ratios = "".join(f"{ratio:>9.3f}" for ratio in np.sqrt(variance) / nominal)
        print(f"{name:<20}{ratios}" + (f"{fitted:>9.3f}{slope:>9.1f}" if math.isfinite(slope) else ""))
    print()


def cost_table() -> None:
    plate = load_plate("quartz16")
    dt_s = 1 / plate.counter.frame_rate_hz
    print(f"{'quartz16, 2 touches':<30}{'share of real time':>20}")
    for frames in (40, 1):
        sites = SitePhysics(plate, Physics(), np.random.default_rng(1))
        force, kelvin = np.zeros((frames, 16)), np.full((frames, 16), np.nan)
        touch = np.zeros((frames, 16), dtype=np.int64)
        force[:, [3, 7]], touch[:, 3], touch[:, 7], kelvin[:, 3] = 2.0, 1, 2, 305.0
        environment = np.full(frames, 298.15)
        elapsed = []
        for _ in range(2000):
            start = time.perf_counter()
            sites.advance(dt_s, force, kelvin, touch, environment)
            elapsed.append(time.perf_counter() - start)
        print(f"{f'{frames} frames at once':<30}{np.median(elapsed) / (frames * dt_s):>20.4f}")


if __name__ == "__main__":
    for gate_s in (1e-3, 5e-3, 1.0):
        allan_table(gate_s)
    cost_table()
