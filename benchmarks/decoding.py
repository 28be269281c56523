"""Decoders of a sheared contact side by side: error against closed forms and time per frame, tails of the time.

Run it with `python benchmarks/decoding.py [SIDE]`. Times are medians over interleaved rounds with one
thread of linear algebra; (x) is the median of the rounds' ratios to the bare transforms of three 48 x 48 fields.
"""

import sys
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.sparse.linalg import LinearOperator, lsqr
from threadpoolctl import threadpool_limits

from resonator_daemon.decoding import FourierDecoder
from resonator_daemon.decoding.open_plane import OpenPlaneDecoder
from resonator_daemon.elastic import HalfSpace, SpectralGrid
from simulators.contact import PressedSpot, pixel_tractions

Floats = NDArray[np.float64]
Decode = Callable[[Floats], Floats]

PITCH_M, DEPTH_M, YOUNGS_PASCAL, FRICTION, STICK_RATIO = 4e-4, 1e-3, 2e5, 0.5, 0.5
RADIUS_M = 2.5e-3
FORCE_NEWTON = (FRICTION * (1.0 - STICK_RATIO**3), 0.0, 1.0)
SKIN = HalfSpace(YOUNGS_PASCAL, 0.5)
DRAWS = 4
SCENES_M = {
    "centred": (0.0,),
    "border": (0.5,),
    "across": (0.86,),
    "outside": (1.25,),
    "two": (0.0, 1.48),
}  # of a half side
LEVELS_DB = (11, 20, 30, 40)


def grid(side: int) -> Floats:
    axis = (np.arange(side) - (side - 1) / 2) * PITCH_M
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def layouts(side: int) -> dict[str, Floats]:
    """Places of about as many sites on one square: regular, hexagonal, random."""
    half_m = side * PITCH_M / 2
    x, y = np.meshgrid(np.arange(side + 1), np.arange(round(side / np.sqrt(0.75)) + 1))
    hexagons = np.column_stack([(x + y % 2 / 2).ravel(), (y * np.sqrt(0.75)).ravel()]) * PITCH_M - half_m
    inside = (np.abs(hexagons) < half_m).all(axis=1)
    random = np.random.default_rng(0).uniform(-half_m, half_m, (side * side, 2))
    return {"grid": grid(side), "hexagonal": hexagons[inside], "random": random}


def signals(sites_m: Floats, centres_m: tuple[float, ...]) -> Floats:
    """Signals (3, n) of contacts centred on the x axis."""
    total = np.zeros((3, len(sites_m)))
    for centre_m in centres_m:
        spot = PressedSpot(sites_m, DEPTH_M, YOUNGS_PASCAL, 0.5, (centre_m, 0.0), RADIUS_M, FRICTION, 1.0)
        total += spot.signals(FORCE_NEWTON)
    return total * np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])


def truth(side: int, centres_m: tuple[float, ...]) -> Floats:
    """Traction (3, side * side) averaged over the pixels of the grid."""
    maps = [pixel_tractions(FORCE_NEWTON, (x, 0.0), RADIUS_M, FRICTION, (side, side), PITCH_M) for x in centres_m]
    return np.asarray(sum(maps), np.float64).reshape(3, -1)


def error(found: Floats, expected: Floats) -> float:
    return float(np.linalg.norm(found.reshape(3, -1) - expected) / np.linalg.norm(expected))


def noise_std(sites_m: Floats, decibel: float) -> float:
    return float(np.sqrt(np.mean(signals(sites_m, (0.0,)) ** 2)) * 10 ** (-decibel / 20))


def dense_matrix(sites_m: Floats, std: float, prior_std_pascal: float) -> NDArray[np.float32]:
    """Single matrix of the same estimate at one scale, made by decoding unit signals on a layout without symmetry."""
    order = np.random.default_rng(0).permutation(len(sites_m))
    decoder = OpenPlaneDecoder(
        SKIN, sites_m[order], DEPTH_M, std, query_positions_m=sites_m, prior_std_pascal=prior_std_pascal
    )
    count = 3 * len(sites_m)
    columns = np.empty((count, count), np.float32)
    for column in range(count):
        unit = np.zeros((3, len(sites_m)))
        unit[column // len(sites_m), column % len(sites_m)] = std
        columns[:, column] = decoder.decode(unit[:, order]).traction_pascal.ravel() / std
    return columns


def most_likely_scale_pascal(sites_m: Floats, std: float, frame: Floats) -> float:
    """Scale of largest evidence among a few decoders that each know only one."""
    unit = 2.0 * SKIN.shear_modulus_pascal * std
    candidates = [unit * 10 ** (exponent / 8) for exponent in range(2, 20)]
    decoders = (OpenPlaneDecoder(SKIN, sites_m, DEPTH_M, std, prior_std_pascal=value) for value in candidates)
    return candidates[int(np.argmax([decoder.decode(frame).log_evidence for decoder in decoders]))]


def printed_recipe(side: int, std: float, power_pascal2: float) -> Decode:
    """Eq. (5) as printed: periodic, white prior of the traction's true mean power, T at omega = 0 of a lone load."""
    spectral = SpectralGrid((side, side), PITCH_M)
    transfer = spectral.transfer_matrix(SKIN, "sensor", "traction", DEPTH_M)
    adjoint = transfer.conj().swapaxes(-1, -2)
    inverse = adjoint @ np.linalg.inv(transfer @ adjoint + std**2 / power_pascal2 * np.eye(3))

    def decode(frame: Floats) -> Floats:
        spectrum = np.moveaxis(fft.rfft2(frame.reshape(3, side, side)), 0, -1)[..., None]
        found = np.moveaxis((inverse @ spectrum)[..., 0], -1, 0)
        return np.asarray(fft.irfft2(found, s=(side, side)), np.float64)

    return decode


def periodic_operator(side: int) -> LinearOperator:
    spectral = SpectralGrid((side, side), PITCH_M)
    transfer = np.moveaxis(spectral.transfer_matrix(SKIN, "sensor", "traction", DEPTH_M), (2, 3), (0, 1))

    def apply(matrix: NDArray[np.complex128], field: Floats) -> Floats:
        spectrum = fft.rfft2(field.reshape(3, side, side))
        return np.asarray(fft.irfft2((matrix * spectrum).sum(axis=1), s=(side, side)), np.float64).ravel()

    adjoint = transfer.conj().swapaxes(0, 1)
    shape = (3 * side * side,) * 2
    return LinearOperator(shape, matvec=lambda f: apply(transfer, f), rmatvec=lambda s: apply(adjoint, s), dtype=float)


def peers(side: int, std: float, rms_pascal: float) -> dict[str, Decode]:
    """Make a decoder of each general inverse library that is installed, on the periodic model."""
    operator = periodic_operator(side)
    damp = std / rms_pascal
    found: dict[str, Decode] = {
        "scipy lsqr": lambda frame: np.asarray(lsqr(operator, frame.ravel(), damp=damp, iter_lim=60)[0], np.float64)
    }
    try:
        import pylops
    except ImportError:
        print("pylops is not installed: left out")
    else:
        wrapped = pylops.LinearOperator(operator)
        found["pylops cgls"] = lambda frame: np.asarray(
            pylops.optimization.basic.cgls(wrapped, frame.ravel(), niter=30, damp=damp)[0], np.float64
        )
    try:
        from skimage.restoration import wiener
    except ImportError:
        print("scikit-image is not installed: left out")
    else:
        spectral = SpectralGrid((side, side), PITCH_M)
        transfer = spectral.transfer_matrix(SKIN, "sensor", "traction", DEPTH_M)
        scalars = [transfer[..., row, column].real for row, column in ((1, 0), (2, 1), (0, 2))]
        channels = (1, 2, 0)

        def each_channel(frame: Floats) -> Floats:
            cube = frame.reshape(3, side, side)
            return np.array(
                [
                    wiener(cube[channel], scalar.astype(complex), damp**2, is_real=True, clip=False)
                    for channel, scalar in zip(channels, scalars, strict=True)
                ]
            )

        found["scikit-image wiener"] = each_channel
    return found


def times_us(work: dict[str, Callable[[], object]], rounds: int = 15) -> dict[str, tuple[float, float]]:
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


def errors_by_scene(side: int) -> None:
    """Error at each level, scene and layout, the sites asked at the grid's pixels."""
    half_m = side * PITCH_M / 2
    print(f"\n{'layout':10} {'decoder':34} {'scene':8}", *(f"{level:>4} dB" for level in LEVELS_DB))
    for layout, sites in layouts(side).items():
        queries = None if layout == "grid" else grid(side)
        for name, keywords in (("open-plane", {}), ("open-plane, equal powers", {"tangential_ratio": 1.0})):
            found = {scene: [] for scene in SCENES_M}
            for level in LEVELS_DB:
                std = noise_std(sites, level)
                decoder = OpenPlaneDecoder(SKIN, sites, DEPTH_M, std, query_positions_m=queries, **keywords)
                for scene, (first, *others) in SCENES_M.items():
                    centres = tuple(x * half_m for x in (first, *others))
                    clean, expected = signals(sites, centres), truth(side, centres)
                    draws = [clean + std * np.random.default_rng(k).standard_normal(clean.shape) for k in range(DRAWS)]
                    found[scene].append(np.mean([error(decoder.decode(d).traction_pascal, expected) for d in draws]))
            for scene, values in found.items():
                print(f"{layout:10} {name:34} {scene:8}", *(f"{value:7.3f}" for value in values))
        if layout != "grid":
            continue
        expected = truth(side, (0.0,))
        for name in ("Fourier", "printed recipe"):
            values = []
            for level in LEVELS_DB:
                std = noise_std(sites, level)
                clean = signals(sites, (0.0,))
                draws = [clean + std * np.random.default_rng(k).standard_normal(clean.shape) for k in range(DRAWS)]
                if name == "Fourier":
                    stack = FourierDecoder(SKIN, (side, side), PITCH_M, DEPTH_M, std).decode(
                        np.reshape(draws, (DRAWS, 3, side, side))
                    )
                    values.append(np.mean([error(one, expected) for one in stack.traction_pascal]))
                else:
                    decode = printed_recipe(side, std, float(np.mean(expected**2)))
                    values.append(np.mean([error(decode(draw), expected) for draw in draws]))
            print(f"{layout:10} {name:34} {'centred':8}", *(f"{value:7.3f}" for value in values))


def times_by_decoder(side: int, level: float) -> None:
    """Time and error of each decoder on one frame of the centred contact."""
    sites = grid(side)
    std, expected = noise_std(sites, level), truth(side, (0.0,))
    frame = signals(sites, (0.0,)) + std * np.random.default_rng(0).standard_normal((3, side * side))
    square = frame.reshape(3, side, side)
    started = time.perf_counter()
    found = OpenPlaneDecoder(SKIN, sites, DEPTH_M, std)
    setup_s = time.perf_counter() - started
    fourier = FourierDecoder(SKIN, (side, side), PITCH_M, DEPTH_M, std)
    fields = np.zeros((3, 48, 48), np.float32)
    decoders: dict[str, Decode] = {}
    if side <= 32:
        given_pascal = most_likely_scale_pascal(sites, std, frame)
        given = OpenPlaneDecoder(SKIN, sites, DEPTH_M, std, prior_std_pascal=given_pascal)
        matrix = dense_matrix(sites, std, given_pascal)
        single = frame.ravel().astype(np.float32)
        decoders["open-plane, scale given"] = lambda _: given.decode(square).traction_pascal
        decoders["dense product"] = lambda _: np.asarray(matrix @ single, np.float64)
    decoders["open-plane"] = lambda _: found.decode(square).traction_pascal
    decoders["open-plane, with displacement"] = lambda _: found.decode(square, displacement=True).traction_pascal
    decoders["Fourier"] = lambda _: fourier.decode(square).traction_pascal
    decoders["printed recipe"] = printed_recipe(side, std, float(np.mean(expected**2)))
    decoders.update(peers(side, std, float(np.sqrt(np.mean(expected**2)))))
    work: dict[str, Callable[[], object]] = {
        "three 48 x 48 transforms": lambda: fft.irfft2(fft.rfft2(fields), s=(48, 48))
    }
    work |= {name: (lambda decode=decode: decode(frame)) for name, decode in decoders.items()}
    print(f"\n{side} x {side}, {level} dB, centred; set-up {setup_s:.1f} s")
    print(f"{'':34} {'us':>9} {'x':>8} {'error':>7}")
    for name, (spent, ratio) in times_us(work).items():
        off = f"{error(decoders[name](frame), expected):7.4f}" if name in decoders else ""
        print(f"{name:34} {spent:9.1f} {ratio:8.2f} {off}")
    tails(found, square)


def tails(decoder: OpenPlaneDecoder, frame: Floats) -> None:
    """Spread of the time per frame in a burst, and when a frame comes every 2 ms."""
    for name, count, pause_s in (("burst", 20_000, 0.0), ("paced at 500 Hz", 1_000, 2e-3)):
        spent = np.empty(count)
        for index in range(count):
            if pause_s:
                time.sleep(pause_s)
            started = time.perf_counter()
            decoder.decode(frame)
            spent[index] = time.perf_counter() - started
        print(f"{name:34} us p50/p99/p99.9:", *(f"{q:.0f}" for q in np.percentile(spent, [50, 99, 99.9]) * 1e6))


def main() -> None:
    sides = [int(sys.argv[1])] if len(sys.argv) > 1 else [32, 64]
    with threadpool_limits(1, user_api="blas"):
        for side in sides:
            for level in (20, 30, 40):
                times_by_decoder(side, level)
            if side <= 32:
                errors_by_scene(side)


if __name__ == "__main__":
    main()
