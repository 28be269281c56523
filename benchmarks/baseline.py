"""A press of 2 N held for ten minutes on a plate that drifts: Kalman filter, moving average and frozen baseline.

Sixteen sites with K = -6.3e-6 / N, frames at 50 Hz, noise of 3e-9 a frame, all tones heard. Columns: error of the
force at the end of the contact (mean of its last 10 s), its largest over the contact, the uncertainty reported at the
end (one standard deviation, noise apart), and the error of untouched sites. Then events that are no single press, and
touches found by their spread over sites, and how the cost of an update grows.
"""

import argparse
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.forces.contact_thermal import warming_std
from resonator_daemon.forces.plate_drift import PlateDrift
from resonator_daemon.forces.spread import SpreadFit
from resonator_daemon.plate import load_plate

SITES = 16
SENSITIVITY = -6.3e-6
NOISE_STD = 3e-9
OFFSET_STD = 2e-7
FRAME_RATE_HZ = 50.0
PRESSED = 3
ONSET_S = 30.0
HELD_S = 600.0
DEPTH_M = 2.5e-3


class Baseline(Protocol):
    """Expected shift of each untouched site, and what it may be off by."""

    def expected(self, shift: Floats, local_kelvin: Floats | None) -> tuple[Floats, Floats]: ...


class MovingAverage:
    """Exponential mean over 10 s, touched or not."""

    def __init__(self) -> None:
        self.mean: Floats | None = None

    def expected(self, shift: Floats, local_kelvin: Floats | None) -> tuple[Floats, Floats]:
        self.mean = shift if self.mean is None else self.mean + (shift - self.mean) / (10.0 * FRAME_RATE_HZ)
        return self.mean, np.full(SITES, np.nan)


class Frozen(MovingAverage):
    """The same, but a site is held while it differs by more than 6 standard deviations."""

    def expected(self, shift: Floats, local_kelvin: Floats | None) -> tuple[Floats, Floats]:
        if self.mean is None:
            self.mean = shift
        quiet = np.abs(shift - self.mean) < 6.0 * NOISE_STD
        self.mean = self.mean + np.where(quiet, (shift - self.mean) / (10.0 * FRAME_RATE_HZ), 0.0)
        return self.mean, np.full(SITES, np.nan)


class Kalman:
    """The product's."""

    def __init__(self, slope: float, coefficient_std: float = 0.0, local_kelvin_std: float = 0.0) -> None:
        self.drift = PlateDrift(
            stated_coefficients(slope),
            coefficient_std=coefficient_std,
            offset_std=OFFSET_STD,
            local_kelvin_std=local_kelvin_std,
        )

    def expected(self, shift: Floats, local_kelvin: Floats | None) -> tuple[Floats, Floats]:
        reading = self.drift.update(shift, np.full(SITES, NOISE_STD**2), 1 / FRAME_RATE_HZ, local_kelvin)
        return reading.expected_shift, reading.expected_std


def stated_coefficients(slope: float) -> Floats:
    return np.array([np.full(SITES, slope), np.full(SITES, -5e-10), np.full(SITES, 1.08e-10)])


def press(
    make: Callable[[], Baseline],
    *,
    seed: int = 1,
    kelvin: float = 2.0,
    slope: float = -3e-7,
    spread: float = 0.0,
    warm_kelvin: float = 0.0,
    thermometer: bool = False,
    ramp_s: float = 0.0,
) -> tuple[float, float, float, float]:
    """End error, largest error, reported at the end, rms of untouched sites; in mN."""
    rng, baseline = np.random.default_rng(seed), make()
    a, b, c = stated_coefficients(slope)
    a = a + spread * rng.normal(size=SITES)
    offset = 1e-5 + OFFSET_STD * rng.normal(size=SITES)
    zero_kelvin = 0.5 * rng.normal(size=SITES)
    errors, others, std = [], [], np.full(SITES, np.nan)
    for t in np.arange(0.0, ONSET_S + HELD_S, 1 / FRAME_RATE_HZ):
        force, warm = np.zeros(SITES), np.zeros(SITES)
        if t >= ONSET_S:
            force[PRESSED] = 2.0 * min(1.0, (t - ONSET_S) / ramp_s) if ramp_s else 2.0
            warm[PRESSED] = -warm_kelvin * np.expm1(-(t - ONSET_S) / 5.0)
        theta = kelvin * np.sin(2 * np.pi * t / 1200.0)
        site = theta + warm
        shift = a * site + b * site**2 + c * site**3 + offset + SENSITIVITY * force
        shift += NOISE_STD * rng.normal(size=SITES)
        local = site + zero_kelvin + 0.01 * rng.normal(size=SITES) if thermometer else None
        expected, std = baseline.expected(shift, local)
        error = 1e3 * ((shift - expected) / SENSITIVITY - force)
        if t >= ONSET_S:
            errors.append(error[PRESSED])
        if t >= 10.0:
            others.append(np.delete(error, PRESSED))
    end = abs(float(np.mean(errors[-round(10 * FRAME_RATE_HZ) :])))
    reported = 1e3 * float(std[PRESSED]) / abs(SENSITIVITY)
    return end, float(np.abs(errors).max()), reported, float(np.sqrt(np.mean(np.square(others))))


def print_presses(plates: int) -> None:
    print(f"{'2 N held for 10 min, mN':52s} {'end':>8s} {'largest':>8s} {'reported':>8s} {'others':>8s}")

    def row(name: str, values: tuple[float, float, float, float]) -> None:
        print(f"{name:52s} " + " ".join(f"{value:8.2f}" for value in values))

    row("moving average over 10 s, +-2 K", press(MovingAverage))
    row("frozen while touched, +-2 K", press(Frozen))
    row("Kalman, +-2 K", press(lambda: Kalman(-3e-7)))
    row("Kalman, +-10 K", press(lambda: Kalman(-3e-7), kelvin=10.0))
    row("Kalman, ramp of 30 s", press(lambda: Kalman(-3e-7), ramp_s=30.0))
    for seed in range(plates):
        values = press(lambda: Kalman(-3e-7, 2e-8), seed=seed, spread=2e-8)
        row(f"Kalman, coefficients off by 2e-8 / K, plate {seed}", values)
    row("Kalman, finger warms its site by 3 K", press(lambda: Kalman(-3e-7), warm_kelvin=3.0))
    stated = 1e3 * warming_std(HELD_S, -3e-7, 3.0) / abs(SENSITIVITY)
    print(f"    systematic of a warm contact, 3 K (one standard deviation): {stated:.0f} mN")
    values = press(lambda: Kalman(-3e-7, 0.0, 0.01), warm_kelvin=3.0, thermometer=True)
    row("Kalman, the same with a thermometer of 10 mK", values)
    row("Kalman, the same with a cut near turnover, 2e-9 / K", press(lambda: Kalman(2e-9), slope=2e-9, warm_kelvin=3.0))


def contacts(theta: Callable[[float], float], force: Callable[[float], Floats], seconds: float) -> tuple[int, int]:
    """Frames times sites in contact, and sites in contact at the end."""
    rng, kalman = np.random.default_rng(2), Kalman(-3e-7)
    a, b, c = stated_coefficients(-3e-7)
    total, now = 0, 0
    for t in np.arange(0.0, seconds, 1 / FRAME_RATE_HZ):
        kelvin = theta(t)
        shift = a * kelvin + b * kelvin**2 + c * kelvin**3 + SENSITIVITY * force(t) + NOISE_STD * rng.normal(size=SITES)
        reading = kalman.drift.update(shift, np.full(SITES, NOISE_STD**2), 1 / FRAME_RATE_HZ)
        now = int(np.count_nonzero(reading.in_contact))
        total += now
    return total, now


def print_events() -> None:
    shock = contacts(lambda t: 2.0 * float(np.clip(t - 5.0, 0.0, 5.0)), lambda t: np.zeros(SITES), 20.0)
    whole = contacts(lambda t: 0.0, lambda t: np.full(SITES, 2.0 * (t > 5.0)), 20.0)
    nine = contacts(lambda t: 0.0, lambda t: 2.0 * (t > 5.0) * (np.arange(SITES) < 9), 20.0)
    print(f"\nthermal shock, 10 K in 5 s: {shock[0]} false contacts")
    print(f"press of the whole plate: {whole[1]} of {SITES} sites in contact")
    print(f"press of nine sites at once: {nine[1]} sites in contact")


def print_touches(pairs: int) -> None:
    sites_m = np.array([site.position_mm for site in load_plate("quartz16").sites]) * 1e-3
    rng, fit = np.random.default_rng(3), SpreadFit(sites_m, DEPTH_M, model_error=0.015)
    print(
        f"\n{'touches on 16 sites, 0.2-8 N, model error 1.5 %':52s} {'found':>8s} {'more':>8s} {'fewer':>8s} {'ms':>8s}"
    )
    for count in (1, 2, 3):
        for anywhere in (False, True):
            found = more = fewer = 0
            costs = []
            for _ in range(pairs):
                position, force = draw_touches(rng, sites_m, count, anywhere)
                share = (1 + np.sum((sites_m[:, None] - position) ** 2, axis=2) / DEPTH_M**2) ** -1.5
                felt = (share @ force) * (1 + 0.015 * rng.normal(size=SITES)) + 1e-3 * rng.normal(size=SITES)
                start = time.process_time()
                touches = fit.fit(felt, np.full(SITES, 1e-6))
                costs.append(time.process_time() - start)
                more += len(touches.force_newton) > count
                fewer += len(touches.force_newton) < count
                apart = np.linalg.norm(touches.position_m[:, None] - position, axis=2)
                found += len(touches.force_newton) == count and bool((apart.min(axis=0) < DEPTH_M).all())
            name = f"{count}, {'anywhere' if anywhere else 'on sites'}, at least 5 mm apart"
            rates = " ".join(f"{outcome / pairs:8.3f}" for outcome in (found, more, fewer))
            print(f"{name:52s} {rates} {1e3 * np.median(costs):8.2f}")


def draw_touches(rng: np.random.Generator, sites_m: Floats, count: int, anywhere: bool) -> tuple[Floats, Floats]:
    while True:
        on_sites = sites_m[rng.choice(SITES, count, replace=False)]
        position = rng.uniform(-9e-3, 9e-3, (count, 2)) if anywhere else on_sites
        apart = np.linalg.norm(position[:, None] - position, axis=2) + np.eye(count)
        if apart.min() >= 5e-3:
            return position, rng.uniform(0.2, 8.0, count)


def print_growth() -> None:
    print("\ncost of one update, relative to 16 sites")
    base = None
    for sites in (16, 64, 256, 1024):
        rng = np.random.default_rng(4)
        drift = PlateDrift(
            np.array([np.full(sites, -3e-7), *np.zeros((2, sites))]), coefficient_std=0.0, offset_std=2e-7
        )
        shifts, variance = NOISE_STD * rng.normal(size=(300, sites)), np.full(sites, NOISE_STD**2)
        start = time.process_time()
        for shift in shifts:
            drift.update(shift, variance, 0.02)
        cost = (time.process_time() - start) / len(shifts)
        base = base or cost
        print(f"{sites:6d} sites {cost / base:6.2f}   ({1e6 * cost:.0f} us here)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plates", type=int, default=3, help="plates with unknown differences of coefficients")
    parser.add_argument("--draws", type=int, default=500, help="scenes of each kind for the position fit")
    arguments = parser.parse_args()
    print_presses(arguments.plates)
    print_events()
    print_touches(arguments.draws)
    print_growth()


if __name__ == "__main__":
    main()
