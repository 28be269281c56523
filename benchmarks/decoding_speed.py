"""Time per frame and error of decoders and of what else could do it, on the centred contact; tails of the time."""

import time
from collections.abc import Callable

import numpy as np
from decoding_peers import (
    Decode,
    DenseEstimates,
    channels_restored,
    periodic_operator,
    pixel_operator,
    printed_recipe,
    solvers,
)
from decoding_scenes import DEPTH_M, LEVELS_DB, NOISE_STD, PITCH_M, SKIN, Floats, Scene, contact, error, frame_of, grid
from scipy import fft

from resonator_daemon.decoding import FourierDecoder, OpenPlaneDecoder
from resonator_daemon.decoding.prior import Prior

TIMED_DB = 30
GIVEN = 0.5  # standard deviation of f_z given to the prior, over the rms in the array: about the most likely one
TRANSFORMS, GIVEN_SCALE, FOUND_SCALE = "three 48 x 48 transforms", "open-plane, scale given", "open-plane"
DENSE, LSQR, PYLOPS = "exact dense product", "scipy lsqr", "pylops cgls"
Work = dict[str, Callable[[], object]]


def times_us(work: Work, rounds: int) -> dict[str, tuple[float, float]]:
    """Median time of each, and median ratio to the first, over interleaved rounds."""
    spent: dict[str, list[float]] = {name: [] for name in work}
    for once in work.values():
        once()
    for _ in range(rounds):
        for name, once in work.items():
            started, repeats = time.perf_counter(), 0
            while repeats < 40 and time.perf_counter() - started < 0.02:
                once()
                repeats += 1
            spent[name].append((time.perf_counter() - started) / repeats)
    base = np.array(next(iter(spent.values())))
    return {name: (float(np.median(s) * 1e6), float(np.median(np.array(s) / base))) for name, s in spent.items()}


def frames(sites_m: Floats, side: int) -> dict[int, Scene]:
    rng = np.random.default_rng(0)
    return {level: frame_of(contact(sites_m, side), sites_m, side, level, rng) for level in LEVELS_DB}


def rms(traction: Floats) -> float:
    return float(np.sqrt(np.mean(traction**2)))


def side_by_side(layout: str, decoder: OpenPlaneDecoder, side: int) -> None:
    """Print times at one level, errors at all. The dense matrix of 64 x 64 sites has 604 MB: left out."""
    sites_m, on_grid = decoder.site_positions_m, layout == "grid"
    dense = DenseEstimates(sites_m, grid(side)) if side <= 32 else None
    operator = periodic_operator(side) if on_grid else pixel_operator(sites_m, side)
    fourier = FourierDecoder(SKIN, (side, side), PITCH_M, DEPTH_M, NOISE_STD)
    fields = np.zeros((3, 48, 48), np.float32)
    bare: Callable[[], object] = lambda: fft.irfft2(fft.rfft2(fields), s=(48, 48))  # noqa: E731
    errors: dict[str, list[float]] = {}
    levels: dict[int, Work] = {}
    for level, (frame, truth) in frames(sites_m, side).items():
        found: dict[str, Decode] = {}
        if on_grid and dense:
            given = OpenPlaneDecoder(SKIN, sites_m, DEPTH_M, NOISE_STD, prior=Prior(std_pascal=GIVEN * rms(truth[2])))
            found[GIVEN_SCALE] = lambda frame, given=given: given.decode(frame).traction_pascal
        found[FOUND_SCALE] = lambda frame: decoder.decode(frame).traction_pascal
        found["open-plane, with displacement"] = lambda frame: decoder.decode(frame, displacement=True).traction_pascal
        if on_grid:
            found["Fourier"] = lambda frame: fourier.decode(frame.reshape(3, side, side)).traction_pascal
            found["printed recipe"] = printed_recipe(side, rms(truth))
            found |= channels_restored(side, frame, truth)
        if dense:
            matrix, single = dense.matrix(GIVEN * rms(truth[2])), frame.ravel().astype(np.float32)
            found[DENSE] = lambda _, matrix=matrix, single=single: matrix @ single
        found |= solvers(operator, rms(truth))
        for name, decode in found.items():
            errors.setdefault(name, []).append(error(decode(frame), truth))
        levels[level] = {name: (lambda d=decode, frame=frame: d(frame)) for name, decode in found.items()}
    spent = times_us({TRANSFORMS: bare} | levels[TIMED_DB], 9 if on_grid else 5)
    print(f"\n{layout}, {len(sites_m)} sites to {side} x {side}; times at {TIMED_DB} dB")
    print(f"{'':32} {'us':>9} {'x':>8}", *(f"{level:>5} dB" for level in LEVELS_DB))
    for name, (median_us, ratio) in spent.items():
        print(f"{name:32} {median_us:9.1f} {ratio:8.2f}", *(f"{value:8.4f}" for value in errors.get(name, [])))
    slower = [f"{name} {spent[name][0] / spent[FOUND_SCALE][0]:.0f}" for name in (DENSE, LSQR, PYLOPS) if name in spent]
    print("times as long as open-plane:", *slower)
    if on_grid:
        for level in (20, 40):
            own = {name: work for name, work in levels[level].items() if name in (GIVEN_SCALE, FOUND_SCALE)}
            at_level = times_us({TRANSFORMS: bare} | own, 9)
            print(f"at {level} dB, us (x):", *(f"{name} {us:.1f} ({x:.2f})" for name, (us, x) in at_level.items()))
        tails(levels[TIMED_DB])


def tails(work: Work) -> None:
    """Spread of the time per frame in a burst, and when a frame comes every 2 ms."""
    for name, count, pause_s in (("burst of 20 000", 20_000, 0.0), ("paced at 500 Hz", 2_000, 2e-3)):
        spent = np.empty(count)
        for index in range(count):
            if pause_s:
                time.sleep(pause_s)
            started = time.perf_counter()
            work[FOUND_SCALE]()
            spent[index] = time.perf_counter() - started
        print(f"{name:32} us p50/p99/p99.9:", *(f"{q:.0f}" for q in np.percentile(spent, [50, 99, 99.9]) * 1e6))
