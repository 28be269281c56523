"""Counting against its bounds: the regression's variance, merged gates, and the flag of beats.

Run it with `python benchmarks/counting.py [SCALE]`; SCALE multiplies the numbers of windows and draws. Every stamp is
written out and rounded down to its tick. Ratios are of the variance to the Cramer-Rao bound of white noise,
12 (s^2 + 1/12) / (N T^2), s the jitter in ticks; a ratio of n windows is known to sqrt(2 / n). "near" is an interval
between stamps of a whole number of ticks and 0.66 turns over the window, the worst; "far" is the golden ratio off one.
"""

import sys
from collections.abc import Iterator

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.tones.frequency_estimators import Sums
from resonator_daemon.tones.quantisation import EXCESS_LIMIT, beats, quantisation_excess, stamp_jitter_ticks

REFERENCE_HZ = 1e9
STAMP_S = 10e-6
GOLDEN = (5**0.5 - 1) / 2
CHUNK = 4_000_000  # stamps at a time


def stamped(rng: np.random.Generator, interval: float, jitter: float, stamps: int, windows: int) -> Floats:
    """Ticks (windows, stamps) less those of the same stamps without noise, rounded down."""
    line = interval % 1.0 * np.arange(stamps)
    times = line + rng.random((windows, 1))
    if jitter:
        times += jitter * rng.standard_normal(times.shape)
    return np.asarray(np.floor(times) - line)


def slopes(errors: Floats) -> Floats:
    lever = np.arange(errors.shape[1]) - (errors.shape[1] - 1) / 2
    return np.asarray(errors @ lever / (lever @ lever))


def bound(jitter: float, stamps: int) -> float:
    return 12 * (jitter**2 + 1 / 12) / (stamps * (stamps**2 - 1))


def variance_ratio(rng: np.random.Generator, interval: float, jitter: float, stamps: int, windows: int) -> float:
    total, left = 0.0, windows
    while left:
        count = min(left, max(1, CHUNK // stamps))
        total += float(np.sum(slopes(stamped(rng, interval, jitter, stamps, count)) ** 2))
        left -= count
    return total / windows / bound(jitter, stamps)


def omega_table(scale: float) -> None:
    rng = np.random.default_rng(1)
    print("Variance of Omega over the Cramer-Rao bound; stamps every 10 us; * where the flag is up")
    print("  tick   jitter           |  far: 1 ms   10 ms  100 ms  predicted  | near: 1 ms   10 ms   100 ms  predicted")
    print("    ns       ns    ticks  |")
    windows = {100: round(20_000 * scale), 1000: round(8000 * scale), 10_000: round(1200 * scale)}
    worst = 0.0
    for tick_ns in (0.02, 0.28, 1.0, 4.0, 5.9, 16.0, 21.0):
        for jitter_ns in (0.0, 0.3, 0.7 * tick_ns):
            jitter, cells = jitter_ns / tick_ns, []
            for near in (False, True):
                whole = np.floor(STAMP_S * 1e9 / tick_ns)
                for stamps, count in windows.items():
                    interval = whole + (0.66 / stamps if near else GOLDEN)
                    ratio = variance_ratio(rng, interval, jitter, stamps, count)
                    flag = bool(beats(interval, jitter, stamps))
                    worst = worst if flag else max(worst, (ratio - 1.05) / np.sqrt(2 / count))
                    cells.append(f"{ratio:8.2f}{'*' if flag else ' '}")
                cells.append(f"{1 + quantisation_excess(interval, jitter, stamps):8.2f} ")
            print(
                f"{tick_ns:6.2f} {jitter_ns:8.2f} {jitter:8.3f}  | {' '.join(cells[:4])} | {' '.join(cells[4:])}",
                flush=True,
            )
    print(f"Largest ratio without a flag: 1.05 and {worst:.1f} standard deviations of its own sampling\n")


def merge_table(scale: float) -> None:
    rng = np.random.default_rng(2)
    gates, stamps, jitter, interval = 10, 100, 0.7, 1e4 + GOLDEN
    errors = stamped(rng, interval, jitter, gates * stamps, round(5000 * scale))
    each = slopes(errors.reshape(-1, stamps)).reshape(-1, gates)
    halves = errors.reshape(len(errors), 2, -1).mean(axis=2)
    rows = {
        "Omega, ten gates merged": slopes(errors),
        "Lambda, two halves": (halves[:, 1] - halves[:, 0]) / (gates * stamps / 2),
        "Pi, first and last stamp": (errors[:, -1] - errors[:, 0]) / (gates * stamps - 1),
        "mean of ten Omega frequencies": each.mean(axis=1),
        "one gate's Omega": each[:, 0],
    }
    best = np.sqrt(bound(jitter, gates * stamps))
    print("Ten gates of 1 ms, 100 stamps each; standard deviation over the bound of 10 ms")
    for name, values in rows.items():
        print(f"  {name:32s} {np.sqrt(np.mean(values**2)) / best:8.2f}")
    print()


def draws(rng: np.random.Generator, count: int, near: bool) -> Iterator[tuple[float, float, int]]:
    for _ in range(count):
        stamps, q = int(rng.choice([100, 300, 1000])), int(rng.integers(1, 9))
        distance = rng.choice([-1, 1]) * 10 ** rng.uniform(-1.5, 1.5) / stamps / q
        interval = rng.integers(0, q) / q + distance if near else rng.random()
        yield 1000 + interval, rng.uniform(0.0, 0.6), stamps


def sums_of(errors: Floats, interval: float) -> Sums:
    """Add up one window as a board does."""
    index = np.arange(len(errors))
    ticks = np.rint(errors + interval % 1.0 * index).astype(np.int64) + int(interval) * index
    offsets = ticks - ticks[0]
    curvature = np.diff(offsets, 2)
    totals = (int(part) for part in (offsets[-1], offsets.sum(), index @ offsets, curvature @ curvature))
    return Sums(0, 0, len(offsets), 10, *totals, len(offsets) - 2)


def flag_table(scale: float) -> None:
    print(
        "The flag of beats for 100 to 1000 stamps with 0 to 0.6 ticks of jitter, told or from Q2; interval as measured."
    )
    print(
        f"Due: excess of variance above {EXCESS_LIMIT:.0%}; undue: below; beats that help: variance below the bound's."
    )
    print("Cases within 3 standard deviations of a limit are left out.")
    print("                         |        missed, jitter  |         raised, jitter |         raised, jitter")
    print("intervals          cases |  due       told from Q2 | undue      told from Q2 | helpful    told from Q2")
    windows, seen = 1000, 4
    margin = 3 * np.sqrt(2 / windows)
    for name, near in (("near p/q, q < 9", True), ("uniform", False)):
        rng, tally = np.random.default_rng(3), np.zeros((3, 3))
        cases = round(800 * scale)
        for interval, jitter, stamps in draws(rng, cases, near):
            errors = stamped(rng, interval, jitter, stamps, windows)
            found = slopes(errors)
            excess = float(np.mean(found**2)) / bound(jitter, stamps) - 1
            records = [stamp_jitter_ticks(sums_of(row, interval)) for row in errors[:seen]]
            flags = beats(interval + found[:seen], [[jitter] * seen, records], stamps).mean(axis=1)
            if excess > EXCESS_LIMIT + margin * (1 + excess):
                tally[0] += 1, *(1 - flags)
            elif excess < -margin:
                tally[2] += 1, *flags
            elif excess < EXCESS_LIMIT - margin / 2:
                tally[1] += 1, *flags
        cells = [f"{total:4.0f} {told / max(total, 1):10.1%} {q2 / max(total, 1):7.1%}" for total, told, q2 in tally]
        print(f"{name:16s} {cases:7d} |{' |'.join(cells)}", flush=True)
    rng = np.random.default_rng(4)
    interval, stamps = 1000 + 6e-4, 1000
    errors = stamped(rng, interval, 0.0, stamps, 2000)
    q2 = np.mean([(part := sums_of(row, interval)).q2_ticks2 / (6 * part.second_differences) for row in errors[:200]])
    ratio = float(np.mean(slopes(errors) ** 2)) / bound(0.0, stamps)
    print(
        f"A slow beat: variance {ratio:.0f} times the bound, while Q2 tells {q2 * 12:.2f} of the variance of rounding\n"
    )


def main(scale: float) -> None:
    omega_table(scale)
    merge_table(scale)
    flag_table(scale)


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 1.0)
