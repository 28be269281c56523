"""Fields under a Hertz pressure with equal shear: each method's error and time against those of the periodic one.

Run it with `python benchmarks/elastic_fields.py [ROUNDS]`. Times are medians over interleaved rounds.
"""

import argparse
import time

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.elastic import HalfSpace
from resonator_daemon.elastic.fields import Method, SurfaceFields
from simulators.contact import pixel_tractions
from simulators.half_space_fields import hertz_fields

SIDE_M, RADIUS_M, YOUNGS_PASCAL = 12.8e-3, 2e-3, 2e5
METHODS: tuple[Method, ...] = ("periodic", "padded", "wrap-free")


def truth(count: int, poisson_ratio: float, depth_m: float) -> Floats:
    """Signals [3 p_n / (2 E), eps_xz, eps_yz] under 1 N along x and 1 N along z, shape (3, count, count)."""
    axis = (np.arange(count) - (count - 1) / 2.0) * SIDE_M / count
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    along_x, _, along_z = hertz_fields(places, depth_m, [RADIUS_M], YOUNGS_PASCAL, poisson_ratio)[0]
    signals = (along_x + along_z) * np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])
    return np.asarray(signals.reshape(3, count, count), np.float64)


def errors(found: Floats, expected: Floats) -> Floats:
    off = np.linalg.norm(found - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    return np.asarray(off, np.float64)


def measure(count: int, poisson_ratio: float, depth_m: float, rounds: int) -> None:
    """Print a line for each method."""
    load = pixel_tractions((1.0, 0.0, 1.0), (0.0, 0.0), RADIUS_M, 1.0, (count, count), SIDE_M / count)
    expected = truth(count, poisson_ratio, depth_m)
    maps, setup_s = {}, {}
    for method in METHODS:
        started = time.perf_counter()
        maps[method] = SurfaceFields(
            HalfSpace(YOUNGS_PASCAL, poisson_ratio), (count, count), SIDE_M / count, "sensor", depth_m, method=method
        )
        setup_s[method] = time.perf_counter() - started
    spent_s: dict[Method, list[float]] = {method: [] for method in METHODS}
    for _ in range(rounds):
        for method in METHODS:
            started = time.perf_counter()
            maps[method](load)
            spent_s[method].append(time.perf_counter() - started)
    for method in METHODS:
        p_n, xz, yz = errors(maps[method](load), expected)
        median_s, base_s = np.median(spent_s[method]), np.median(spent_s["periodic"])
        print(
            f"{poisson_ratio:4} {depth_m * 1e3:5} {count:4}  {method:9} {p_n:9.1e} {xz:9.1e} {yz:9.1e}"
            f" {median_s * 1e6:9.0f} {median_s / base_s:7.2f} {setup_s[method] * 1e3:9.1f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("rounds", type=int, nargs="?", default=40, help="times each is timed (default: 40)")
    rounds: int = parser.parse_args().rounds
    print(f"{'nu':>4} {'z mm':>5} {'n':>4}  {'method':9} {'p_n':>9} {'eps_xz':>9} {'eps_yz':>9}", end=" ")
    print(f"{'apply us':>9} {'ratio':>7} {'set-up ms':>9}")
    for poisson_ratio in (0.3, 0.5):
        for count in (32, 128, 256):
            measure(count, poisson_ratio, 1e-3, rounds)
    for depth_m in (0.4e-3, 0.2e-3, 0.1e-3):
        for count in (32, 128):
            measure(count, 0.3, depth_m, rounds)


if __name__ == "__main__":
    main()
