"""What the matcher finds, misses and gets wrong on ladders and on codes that overlap, and what a call costs.

Run it with `OMP_NUM_THREADS=1 python benchmarks/matching.py [--draws N]`; 20 000 draws take a minute. Every touch is
drawn with the errors that the model names, at their stated sizes, on the channels' frequencies. Times are those of the
process, medians of interleaved rounds; the ratio is to the first row.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.arrays import Floats
from resonator_daemon.forces.codes import code_overlaps
from resonator_daemon.forces.site_identification import MODEL_ERROR, Match, Matcher
from resonator_daemon.plate import load_plate

LARGEST_NEWTON = 10.0
STATUSES = ("ok", "ambiguous", "rejected", "overload")
SENSITIVITY = -6.3e-6
MIXED = np.array([1.0, -1.0, 1.0, -1.0])
UNEQUAL = np.array([0.65, 0.9, 1.1, 1.35])
OSCILLATOR_STD, COMMON_MODE_STD = 1e-9, 2e-7
SITES = (16, 64, 256, 1024)
TIMED_ROUNDS, TIMED_CALLS = 15, 40


class Codes(NamedTuple):
    """Codes of m sites, (m, 4)."""

    f0_hz: Floats
    sensitivity: Floats


def ladder(step: float, sites: int = 16, *, pull: float = 25e-6, signs: Floats | float = 1.0, seed: int = 1) -> Codes:
    rng = np.random.default_rng(seed)
    code = rng.permutation(sites)[:, None] * np.ones(4)
    f0_hz = 100e6 * np.exp(-step * code + rng.uniform(-pull, pull, (sites, 4)))
    return Codes(f0_hz, SENSITIVITY * rng.uniform(0.7, 1.3, (sites, 1)) * np.ones(4) * signs)


def tuples(span: float, sites: int = 16, seed: int = 1) -> Codes:
    rng = np.random.default_rng(seed)
    f0_hz = 10e6 * np.exp(-rng.uniform(0, span, (sites, 4)))
    return Codes(f0_hz, SENSITIVITY * rng.uniform(0.7, 1.3, (sites, 1)) * np.ones(4))


class Drawn(NamedTuple):
    """Touches (n, touches), frequencies (n, 4) and which touch each channel hears (n, 4)."""

    site: NDArray[np.int64]
    force_newton: Floats
    frequency_hz: Floats
    heard: NDArray[np.int64]


def draw(
    codes: Codes,
    heard: NDArray[np.int64],
    rng: np.random.Generator,
    *,
    newton: tuple[float, float] = (0.1, 9.0),
    model_error: float = MODEL_ERROR,
    counter_std: float = 5e-10,
    oscillator_std: float = OSCILLATOR_STD,
    common_mode_std: float = COMMON_MODE_STD,
) -> Drawn:
    count, touches, shape = len(heard), int(heard.max()) + 1, heard.shape
    site = rng.permuted(np.tile(np.arange(len(codes.f0_hz)), (count, 1)), axis=1)[:, :touches]
    force = rng.uniform(*newton, site.shape)
    tone = np.take_along_axis(site, heard, axis=1), np.arange(4)
    error = counter_std * rng.normal(size=shape)
    error += np.hypot(oscillator_std, common_mode_std) * rng.normal(size=(count, 1))
    k = codes.sensitivity[tone] * (1 + model_error * rng.normal(size=shape))
    return Drawn(site, force, codes.f0_hz[tone] / (1 - k * np.take_along_axis(force, heard, axis=1) - error), heard)


def match_all(
    matcher: Matcher, frequency_hz: Floats, counter_std: float, oscillator_std: float, common_mode_std: float
) -> list[Match]:
    return [matcher.match(row, [counter_std] * 4, oscillator_std, common_mode_std) for row in frequency_hz.tolist()]


def named(matches: list[Match]) -> list[dict[int, float]]:
    """Force by site that each reading names."""
    return [{force.site: force.force_newton for force in match.forces} for match in matches]


def wrong(matches: list[Match], site: NDArray[np.int64]) -> int:
    return sum(not found.keys() <= set(true) for found, true in zip(named(matches), site.tolist(), strict=True))


def share(matches: list[Match], status: str) -> float:
    return sum(match.status == status for match in matches) / len(matches)


def errors_newton(matches: list[Match], drawn: Drawn) -> Floats:
    """Return by how much each force of the first touch is off, NaN where it is not named."""
    true = zip(drawn.site[:, 0].tolist(), drawn.force_newton[:, 0].tolist(), strict=True)
    return np.array(
        [found.get(site, np.nan) - newton for found, (site, newton) in zip(named(matches), true, strict=True)]
    )


def one_touch(count: int) -> None:
    print(f"\nOne touch, {count} draws each; shares of outcomes; errors over the Cramer-Rao bound")
    print(
        f"{'codes':32} {'counter':>8} "
        + " ".join(f"{status:>9}" for status in STATUSES)
        + "     wrong  err/bound  chi2"
    )
    plates = {
        "400 ppm ladder": ladder(400e-6),
        "400 ppm ladder, mixed signs": ladder(400e-6, signs=MIXED),
        "150 ppm ladder": ladder(150e-6),
        "60 ppm ladder, channels alike": ladder(60e-6, pull=0.0),
        "60 ppm ladder, pulled": ladder(60e-6),
        "random within 60 ppm": tuples(60e-6),
    }
    for name, codes in plates.items():
        for counter_std in (5e-10, 1e-8, 3e-6):
            drawn = draw(codes, np.zeros((count, 4), int), np.random.default_rng(1), counter_std=counter_std)
            matcher = Matcher(*codes, LARGEST_NEWTON)
            matches = match_all(matcher, drawn.frequency_hz, counter_std, OSCILLATOR_STD, COMMON_MODE_STD)
            site, force = drawn.site[:, 0], drawn.force_newton[:, 0]
            k = codes.sensitivity[site]
            inverse = 1 / (counter_std**2 + (MODEL_ERROR * k * force[:, None]) ** 2)
            common = 1 / (1 / (OSCILLATOR_STD**2 + COMMON_MODE_STD**2) + inverse.sum(axis=1))
            information = (k * k * inverse).sum(axis=1) - common * (k * inverse).sum(axis=1) ** 2
            ratio = np.sqrt(np.nanmean(errors_newton(matches, drawn) ** 2 * information))
            shares = " ".join(f"{share(matches, status):9.5f}" for status in STATUSES)
            print(
                f"{name:32} {counter_std:8.0e} {shares} {wrong(matches, drawn.site):9d} {ratio:10.4f} "
                f"{np.nanmean([match.chi2 for match in matches]):5.2f}"
            )


def unmodelled(count: int) -> None:
    print("\nAccepted where the error of K is not modelled (counter 1e-8, 0.2-8 N), and where it is")
    for error, model_error in ((0.003, 0.0), (0.01, 0.0), (0.003, 0.01), (0.01, 0.01)):
        noise = {"counter_std": 1e-8, "oscillator_std": 0.0, "common_mode_std": 0.0}
        rng = np.random.default_rng(2)
        codes = ladder(400e-6)
        drawn = draw(codes, np.zeros((count, 4), int), rng, newton=(0.2, 8.0), model_error=error, **noise)
        matcher = Matcher(*codes, LARGEST_NEWTON, model_error=model_error)
        matches = match_all(matcher, drawn.frequency_hz, 1e-8, 0.0, 0.0)
        print(f"  K off by {100 * error:.1f} %, modelled {100 * model_error:.1f} %: {share(matches, 'ok'):.4f}")
    print("A common mode of 1e-7 (counter 1e-8): failing the gate if ignored, if modelled, and rms error in mN")
    for name, factors in (("channels alike", np.ones(4)), ("unequal K", UNEQUAL), ("mixed signs", UNEQUAL * MIXED)):
        codes = Codes(ladder(400e-6).f0_hz, SENSITIVITY * np.ones((16, 1)) * factors)
        noise = {"counter_std": 1e-8, "oscillator_std": 0.0, "common_mode_std": 1e-7}
        rng = np.random.default_rng(3)
        drawn = draw(codes, np.zeros((count, 4), int), rng, newton=(0.2, 8.0), model_error=0.0, **noise)
        matcher = Matcher(*codes, LARGEST_NEWTON, model_error=0.0)
        ignored = match_all(matcher, drawn.frequency_hz, 1e-8, 0.0, 0.0)
        matches = match_all(matcher, drawn.frequency_hz, 1e-8, 0.0, 1e-7)
        error_mn = 1e3 * np.sqrt(np.nanmean(errors_newton(matches, drawn) ** 2))
        print(f"  {name:16} {1 - share(ignored, 'ok'):.4f} {1 - share(matches, 'ok'):.5f} {error_mn:6.2f}")


def several_touches(count: int) -> None:
    print(f"\nChannels that hear different sites, {count} each: both found, first found, wrong, rms error / stated")
    shipped = load_plate("quartz16").tones
    plates = {
        "quartz16": Codes(shipped.f0_hz, shipped.sensitivity),
        "400 ppm ladder, mixed signs": ladder(400e-6, signs=MIXED),
        "60 ppm ladder, pulled": ladder(60e-6),
        "random within 60 ppm": tuples(60e-6),
    }
    for name, codes in plates.items():
        for what, least, most in (("one channel of four", 1, 1), ("one to three channels", 1, 3)):
            rng = np.random.default_rng(4)
            order = rng.permuted(np.tile(np.arange(4), (count, 1)), axis=1)
            heard = (order < rng.integers(least, most + 1, (count, 1))).astype(int)
            drawn = draw(codes, heard, rng, newton=(0.2, 8.0))
            matches = match_all(
                Matcher(*codes, LARGEST_NEWTON), drawn.frequency_hz, 5e-10, OSCILLATOR_STD, COMMON_MODE_STD
            )
            found, true = named(matches), drawn.site.tolist()
            both = np.mean([set(of) == set(sites) for of, sites in zip(found, true, strict=True)])
            first = np.mean([sites[0] in of for of, sites in zip(found, true, strict=True)])
            errors = [
                (force.force_newton - drawn.force_newton[row, true[row].index(force.site)])
                / np.hypot(force.noise_newton, force.systematic_newton)
                for row, match in enumerate(matches)
                for force in match.forces
                if force.site in true[row] and force.status == "ok"
            ]
            rms = np.sqrt(np.mean(np.square(errors))) if errors else np.nan
            print(f"  {name:30} {what:22} {both:.4f} {first:.4f} {wrong(matches, drawn.site):5d} {rms:6.3f}")


def common_error(count: int) -> None:
    print(f"\nWrong of {count} touches (0.2-9.9 N) whose tones are all off by an error that the matcher is not told")
    print(f"{'step':>10} " + " ".join(f"{ppm:>7.0f} ppm" for ppm in (0, 10, 20, 40)))
    for step in (100e-6, 150e-6, 400e-6):
        codes, shares = ladder(step, pull=0.0), []
        for shift in (0.0, 10e-6, 20e-6, 40e-6):
            rng = np.random.default_rng(5)
            drawn = draw(codes, np.zeros((count, 4), int), rng, newton=(0.2, 9.9))
            sign = rng.choice([-1.0, 1.0], (count, 1))
            matches = match_all(
                Matcher(*codes, LARGEST_NEWTON),
                drawn.frequency_hz * (1 + sign * shift),
                5e-10,
                OSCILLATOR_STD,
                COMMON_MODE_STD,
            )
            shares.append(wrong(matches, drawn.site) / count)
        print(f"{step * 1e6:6.0f} ppm " + " ".join(f"{value:11.5f}" for value in shares))


def times_us(work: dict[str, Callable[[], object]], calls: int) -> Iterator[tuple[str, float, float]]:
    """Median processor time of a call, and its median ratio to the first, over interleaved rounds."""
    spent: dict[str, list[float]] = {name: [] for name in work}
    for once in work.values():
        once()
    for _ in range(TIMED_ROUNDS):
        for name, once in work.items():
            started = time.process_time()
            for _ in range(calls):
                once()
            spent[name].append((time.process_time() - started) / calls)
    base = np.array(next(iter(spent.values())))
    for name, each in spent.items():
        yield name, float(np.median(each)) * 1e6, float(np.median(np.array(each) / base))


def cost() -> None:
    print("\nProcessor time of a call in µs, and its ratio to that of 16 sites, by outcome (400 ppm ladder, pulled)")
    kinds = ("one site", "two sites", "left out", "overload", "disagree")
    for kind in kinds:
        work: dict[str, Callable[[], object]] = {}
        for sites in SITES:
            codes = ladder(400e-6, sites)
            hz = {newton: codes.f0_hz[5] / (1 - codes.sensitivity[5] * newton) for newton in (2.0, 12.0)}
            other = codes.f0_hz[9] / (1 - codes.sensitivity[9] * 3.0)
            frequency = {
                "one site": hz[2.0],
                "two sites": np.where([True, True, False, False], hz[2.0], other),
                "left out": np.where([True, True, True, False], hz[2.0], codes.f0_hz.max() * 1.01),
                "overload": hz[12.0],
                "disagree": hz[2.0] * (1 + 5e-6 * MIXED),
            }[kind]
            matcher = Matcher(*codes, LARGEST_NEWTON)
            work[f"{sites}"] = lambda matcher=matcher, frequency=frequency: matcher.match(  # type: ignore[misc]
                frequency, np.full(4, 5e-10), OSCILLATOR_STD, COMMON_MODE_STD
            )
        print(f"  {kind:10} " + "   ".join(f"{n:>4}: {us:7.1f} ({r:4.2f})" for n, us, r in times_us(work, TIMED_CALLS)))


def overlaps() -> None:
    print("\nPairs of codes that overlap (common shift 10 ppm, margin 9 ppm), and processor time to find them")
    for sites in SITES:
        plates = {
            "400 ppm ladder": ladder(400e-6, sites),
            "60 ppm ladder, channels alike": ladder(60e-6, sites, pull=0.0),
            "random within 60 ppm": tuples(60e-6, sites),
        }
        for name, codes in plates.items():
            started = time.process_time()
            found = code_overlaps(*codes, LARGEST_NEWTON, common_shift=10e-6, margin=9e-6)
            worst = f"{found[0].spacing_ppm:.1f} ppm apart, {found[0].needed_ppm:.1f} needed" if found else ""
            print(f"  {sites:5d} {name:30} {len(found):7d} {time.process_time() - started:6.2f} s  {worst}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=20_000)
    draws = parser.parse_args().draws
    one_touch(draws)
    unmodelled(draws // 10)
    several_touches(draws // 20)
    common_error(draws // 10)
    cost()
    overlaps()


if __name__ == "__main__":
    main()
