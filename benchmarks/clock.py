"""The board's clock over links of known delays: error of instants, their stated bound, and the time to know it.

Columns: root mean square and 99th percentile of the error from the fifth second on, median of the stated uncertainty,
share of instants within three times it and within it, the second from which on the error over a second and all seeds
is below 200 us rms for the rest of the run, pings a second over the whole run, exchanges set aside and restarts.
Then what an exchange and an instant cost.
"""

import argparse
import math
import statistics
import time
from collections import defaultdict

from clock_scenes import NS, UTC_LESS_MONOTONIC_NS, Crystal, Scene, between, play, scenes

from resonator_daemon.session.clock import BoardClock, Exchange

SETTLED_S = 5.0
LIMIT_US = 200.0


class CountingClock(BoardClock):
    """A board's clock that counts what it is given."""

    exchanges = 0

    def add(self, exchange: Exchange, utc_less_monotonic_ns: int, *, boottime_less_monotonic_ns: int = 0) -> None:
        self.exchanges += 1
        super().add(exchange, utc_less_monotonic_ns, boottime_less_monotonic_ns=boottime_less_monotonic_ns)


def row(scene: Scene, seeds: int, seconds: float) -> str:
    errors, bounds = [], []
    squares: defaultdict[int, list[float]] = defaultdict(list)
    pings = outliers = restarts = 0
    for seed in range(seeds):
        clock = CountingClock(scene.crystal.reference_millihertz)
        start_ns = 5 * NS
        for look in play(scene, seed, seconds, clock=clock, start_ns=start_ns):
            age_s = (look.monotonic_ns - start_ns) / NS
            squares[int(age_s)].append((look.error_ns / 1e3) ** 2)
            if age_s >= SETTLED_S:
                errors.append(look.error_ns / 1e3)
                bounds.append(look.said.uncertainty_ns / 1e3)
        pings += clock.exchanges
        outliers, restarts = outliers + clock.outliers, restarts + clock.restarts
    sizes = sorted(map(abs, errors))
    within = [sum(e <= k * u for e, u in zip(map(abs, errors), bounds, strict=True)) / len(errors) for k in (3, 1)]
    settled_s = max(
        (second + 1 for second, of_it in squares.items() if statistics.fmean(of_it) > LIMIT_US**2), default=0
    )
    settled = f"{settled_s}" if settled_s < seconds else "never"
    return (
        f"| {scene.name} | {math.sqrt(statistics.fmean(e * e for e in errors)):.0f} "
        f"| {sizes[len(sizes) * 99 // 100]:.0f} | {statistics.median(bounds):.0f} "
        f"| {100 * within[0]:.2f} % | {100 * within[1]:.2f} % | {settled} "
        f"| {pings / seeds / seconds:.1f} | {outliers} | {restarts} |"
    )


def costs() -> str:
    """Return the mean time of an exchange and of an instant."""
    crystal, trip = Crystal(30.0, swing_ppm=20.0), between(50, 150)
    clock = BoardClock(crystal.reference_millihertz)
    for _ in play(Scene("", crystal, trip, trip), 0, 60.0, clock=clock):
        pass
    start_ns, count = 65 * NS, 2000
    exchanges = [
        Exchange(at, crystal.ticks(at + 60_000 + at % 90_001), at + 150_000 + at % 97_001)
        for at in range(start_ns, start_ns + count * 20_000_000, 20_000_000)
    ]
    began = time.process_time()
    for exchange in exchanges:
        clock.add(exchange, UTC_LESS_MONOTONIC_NS)
    add_us = (time.process_time() - began) / count * 1e6
    ticks = exchanges[-1].board_ticks
    began = time.process_time()
    for frame in range(10_000):
        clock.scale.at(ticks + frame)
    return f"add {add_us:.0f} us, at {(time.process_time() - began) / 10_000 * 1e6:.2f} us"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--ppm", type=float, default=50.0)
    arguments = parser.parse_args()
    print(
        "| link | rms µs | p99 µs | t_unc µs | in 3 t_unc | in t_unc | 200 µs in s | pings/s | set aside | restarts |"
    )
    print("|" + " --- |" * 10)
    for scene in scenes(arguments.ppm):
        print(row(scene, arguments.seeds, arguments.seconds), flush=True)
    print(f"\n{costs()}")


if __name__ == "__main__":
    main()
