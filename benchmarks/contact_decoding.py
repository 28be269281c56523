"""Decoding with contact physics beside the linear map: errors, a sliding contact at 200 frames/s, failures noticed.

Run it with `python benchmarks/contact_decoding.py [DRAWS]`. Truth is closed-form. One thread of linear
algebra; the sliding contact's matrices are rebuilt by a second thread that rests 2.4 times as long as it works.
"""

import sys
import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from resonator_daemon.decoding.contact import ContactDecoder
from resonator_daemon.decoding.open_plane import OpenPlaneDecoder
from resonator_daemon.elastic import HalfSpace
from simulators.contact import pixel_tractions
from simulators.half_space_fields import hertz_fields

Floats = NDArray[np.float64]
Scene = tuple[Floats, Floats]  # signals (3, n) without noise, traction (3, ny, nx)

PITCH_M, DEPTH_M, YOUNGS_PASCAL, FRICTION = 4e-4, 1e-3, 2e5, 0.5
SHAPE = (32, 32)
NOISE_STD = 1e-4  # scenes are scaled to reach a ratio
LEVELS_DB = (11, 20, 30, 40)
UNITS = np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])
FRAME_S, SLIDE_M, REST = 5e-3, 6e-5, 2.4
AXIS_M = (np.arange(32) - 15.5) * PITCH_M
SITES_M = np.stack(np.meshgrid(AXIS_M, AXIS_M), axis=-1).reshape(-1, 2)


def contact(
    centre_m: ArrayLike,
    radius_m: float = 2.5e-3,
    stick_ratio: float = 0.5,
    friction: float = FRICTION,
    force_newton: float = 1.0,
    direction: float = 0.0,
) -> Scene:
    """Cattaneo-Mindlin contact: its stick disc carries a second Hertz distribution of shear."""
    x_m, y_m = np.asarray(centre_m, np.float64)
    normal = np.array([0.0, 0.0, force_newton])
    sliding = friction * force_newton * np.array([np.cos(direction), np.sin(direction), 0.0])
    parts = hertz_fields(SITES_M - [x_m, y_m], DEPTH_M, [radius_m, stick_ratio * radius_m], YOUNGS_PASCAL, 0.5)
    signals = np.tensordot(sliding + normal, parts[0], (0, 0))
    signals -= np.tensordot(stick_ratio**3 * sliding, parts[1], (0, 0))
    force = (1.0 - stick_ratio**3) * sliding + normal
    unit_radius_m = radius_m / np.cbrt(force_newton)
    return signals * UNITS, pixel_tractions(force, (x_m, y_m), unit_radius_m, friction, SHAPE, PITCH_M)


def together(one: Scene, other: Scene) -> Scene:
    return one[0] + other[0], one[1] + other[1]


def random_contact(rng: np.random.Generator) -> Scene:
    place_m = rng.uniform(-3e-3, 3e-3, 2)
    return contact(place_m, rng.uniform(1.5e-3, 3e-3), rng.uniform(0.2, 0.9), direction=rng.uniform(0.0, 2.0 * np.pi))


def adhesive(share: float) -> Scene:
    """Surround the centred contact by a ring of pull, 0.5 mm wide, of a share of the peak pressure."""
    signals, traction = contact((0.0, 0.0))
    axis_m = (np.arange(128) - 63.5) * PITCH_M / 4
    x, y = np.meshgrid(axis_m, axis_m)
    ring = np.abs(np.hypot(x, y) - 2.75e-3) < 0.25e-3
    pull = -share * 1.5 / np.pi / 2.5e-3**2
    points = (
        hertz_fields(SITES_M - place, DEPTH_M, [0.0], YOUNGS_PASCAL, 0.5)[0, 2]
        for place in np.column_stack([x[ring], y[ring]])
    )
    held = traction.copy()
    held[2] += pull * ring.reshape(32, 4, 32, 4).mean(axis=(1, 3))
    return signals + sum(points) * (pull * (PITCH_M / 4) ** 2 * UNITS), held


SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "centre": lambda _: contact((0.0, 0.0)),
    "x = 5.5": lambda _: contact((5.5e-3, 0.0)),
    "border": lambda _: contact((6.4e-3, 0.0)),
    "two": lambda _: together(contact((-3e-3, -1e-3), 2e-3), contact((3e-3, 1.5e-3), 1.5e-3, direction=1.0)),
    "random": random_contact,
    "a < 1.5": lambda rng: contact(rng.uniform(-4e-3, 4e-3, 2), rng.uniform(0.8e-3, 1.5e-3), rng.uniform(0.2, 0.9)),
}
FAILURES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "healthy, random": random_contact,
    "mu .65, told .5": lambda _: contact((0.0, 0.0), stick_ratio=1e-3, friction=0.65),
    "adhesion .1 p0": lambda _: adhesive(0.1),
    "adhesion .3 p0": lambda _: adhesive(0.3),
    "light beside heavy": lambda _: together(contact((-2.4e-3, 0.0)), contact((3.4e-3, 0.0), force_newton=0.1)),
}


def frame_of(scene: Scene, decibel: float, rng: np.random.Generator) -> Scene:
    """Scaled to a ratio of total rms to noise, with noise."""
    signals, traction = scene
    scale = NOISE_STD * 10 ** (decibel / 20) / float(np.sqrt(np.mean(signals**2)))
    noisy = signals * scale + NOISE_STD * rng.standard_normal(signals.shape)
    return noisy.reshape(3, *SHAPE), traction * scale


def error(found: Floats, truth: Floats) -> float:
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def errors(linear: OpenPlaneDecoder, decoders: dict[str, ContactDecoder], draws: int) -> None:
    print(f"\nrelative L2 error of the traction\n{'scene':10} {'dB':>3} {'linear':>8}", *(f"{d:>8}" for d in decoders))
    for name, make in SCENES.items():
        for decibel in LEVELS_DB:
            rng = np.random.default_rng(1)
            rows = []
            for _ in range(draws):
                signals, truth = frame_of(make(rng), decibel, rng)
                row = [error(linear.decode(signals).traction_pascal, truth)]
                for decoder in decoders.values():
                    decoder.reset()
                    row.append(error(decoder.decode(signals).traction_pascal, truth))
                rows.append(row)
            print(f"{name:10} {decibel:3}", *(f"{value:8.3f}" for value in np.mean(rows, axis=0)))


def honesty(decoder: ContactDecoder, draws: int) -> None:
    print("\nrandom contacts: within 1 and 2 sd inside, outside; net force x, y, z: bias in % of f_z, rms z")
    for decibel in LEVELS_DB:
        rng = np.random.default_rng(2)
        within, off, z = [], [], []
        for _ in range(draws):
            signals, truth = frame_of(random_contact(rng), decibel, rng)
            decoder.reset()
            decoded = decoder.decode(signals)
            sigmas = np.abs(decoded.traction_pascal - truth) / decoded.traction_std_pascal
            pressed = truth[2] > 0.0
            within.append([np.mean(sigmas[:, area] < limit) for area in (pressed, ~pressed) for limit in (1.0, 2.0)])
            force = truth.sum(axis=(1, 2)) * PITCH_M**2
            load = decoder.net_load(truth[2] > 0.3 * truth[2].max(), (0.0, 0.0))
            if load is not None:
                off.append(100.0 * (load.force_newton - force) / force[2])
                z.append((load.force_newton - force) / load.force_std_newton)
        shown = [*np.mean(within, axis=0), *np.mean(off, axis=0), *np.sqrt(np.mean(np.square(z), axis=0))]
        print(f"{decibel:3}", *(f"{value:7.2f}" for value in shown))


def failures(decoder: ContactDecoder, draws: int) -> None:
    print(
        f"\nnoticed, of {draws} frames (healthy: false alarms); error\n{'':20}", *(f"{db:>14} dB" for db in LEVELS_DB)
    )
    for name, make in FAILURES.items():
        cells = []
        for decibel in LEVELS_DB:
            rng = np.random.default_rng(3)
            noticed, off = 0, []
            for _ in range(draws):
                signals, truth = frame_of(make(rng), decibel, rng)
                decoder.reset()
                decoded = decoder.decode(signals)
                noticed += decoded.reason != ""
                off.append(error(decoded.traction_pascal, truth))
            cells.append(f"{noticed:8}  {np.mean(off):.3f}")
        print(f"{name:20}", *(f"{cell:>17}" for cell in cells))


def sliding(linear: OpenPlaneDecoder) -> None:
    """Let a contact slide to and fro by 0.06 mm per frame under rising shear, at 200 frames/s."""
    x_m = np.arange(-3e-3, 3e-3, SLIDE_M)
    path = [contact((x, 0.0), stick_ratio=1.0 - 0.9 * k / x_m.size) for x in (x_m, x_m[::-1]) for k, x in enumerate(x)]
    centred_rms = float(np.sqrt(np.mean(contact((0.0, 0.0))[0] ** 2)))
    print("\nsliding: error, linear's, us p50 p99 p99.9 per frame and of the linear map, second core")
    for decibel in (20, 30):
        decoder = ContactDecoder(linear, FRICTION, background=True)
        rng = np.random.default_rng(4)
        scale = NOISE_STD * 10 ** (decibel / 20) / centred_rms
        stopped, worked_s = threading.Event(), [0.0]

        def rebuild(
            decoder: ContactDecoder = decoder, stopped: threading.Event = stopped, worked_s: list[float] = worked_s
        ) -> None:
            while not stopped.is_set():
                started = time.perf_counter()
                rest_s = FRAME_S / 2
                if decoder.rebuild():
                    spent = time.perf_counter() - started
                    worked_s[0] += spent
                    rest_s = REST * spent
                stopped.wait(rest_s)

        thread = threading.Thread(target=rebuild)
        thread.start()
        found, plain, spent_s, linear_s = [], [], [], []
        begun = due = time.perf_counter()
        for signals, traction in path * 5:
            frame = (signals * scale + NOISE_STD * rng.standard_normal(signals.shape)).reshape(3, *SHAPE)
            due += FRAME_S
            time.sleep(max(due - time.perf_counter(), 0.0))
            started = time.perf_counter()
            decoded = decoder.decode(frame)
            decoded_at = time.perf_counter()
            only = linear.decode(frame)
            linear_s.append(time.perf_counter() - decoded_at)
            spent_s.append(decoded_at - started)
            found.append(error(decoded.traction_pascal, traction * scale))
            plain.append(error(only.traction_pascal, traction * scale))
        share = worked_s[0] / (time.perf_counter() - begun)
        stopped.set()
        thread.join()
        times = [
            f"{value * 1e6:.0f}" for taken in (spent_s, linear_s) for value in np.percentile(taken, [50, 99, 99.9])
        ]
        print(f"{decibel:3} dB {np.mean(found):.3f} {np.mean(plain):.3f} ", *times, f" {share:.0%}")


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    with threadpool_limits(1):
        linear = OpenPlaneDecoder(HalfSpace(YOUNGS_PASCAL, 0.5), SITES_M, DEPTH_M, NOISE_STD)
        started = time.perf_counter()
        told = ContactDecoder(linear, FRICTION)
        print(f"set-up beyond the linear decoder's: {time.perf_counter() - started:.1f} s")
        untold = ContactDecoder(linear)
        errors(linear, {"mu known": told, "unknown": untold}, draws)
        honesty(untold, 3 * draws)
        failures(told, draws)
        sliding(linear)


if __name__ == "__main__":
    main()
