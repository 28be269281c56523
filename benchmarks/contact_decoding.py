"""Decoding with contact physics compared with the linear map: errors, error bars, failures noticed, a sliding contact.

Run it with `python benchmarks/contact_decoding.py [--draws N]`; 3 draws take about a minute. Truth is closed-form. One
thread of linear algebra; the sliding contact's matrices are rebuilt by a second thread that rests 2.4 times as long as
it works.
"""

import argparse
import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.contact_physics.decoder import ContactDecoder
from resonator_daemon.decoding.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.elastic import HalfSpace
from simulators.contact import pixel_tractions
from simulators.half_space_fields import hertz_fields

Scene = tuple[Floats, Floats]  # signals (3, n) without noise, traction (3, ny, nx)

PITCH_M, DEPTH_M, YOUNGS_PASCAL, FRICTION = 4e-4, 1e-3, 2e5, 0.5
SKIN = HalfSpace(YOUNGS_PASCAL, 0.5)
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
    depth_m: float = DEPTH_M,
    sites_m: Floats = SITES_M,
) -> Scene:
    """Cattaneo-Mindlin contact: its stick disc carries a second Hertz distribution of shear."""
    x_m, y_m = np.asarray(centre_m, np.float64)
    normal = np.array([0.0, 0.0, force_newton])
    sliding = friction * force_newton * np.array([np.cos(direction), np.sin(direction), 0.0])
    parts = hertz_fields(sites_m - [x_m, y_m], depth_m, [radius_m, stick_ratio * radius_m], YOUNGS_PASCAL, 0.5)
    signals = np.tensordot(sliding + normal, parts[0], (0, 0))
    signals -= np.tensordot(stick_ratio**3 * sliding, parts[1], (0, 0))
    force = (1.0 - stick_ratio**3) * sliding + normal
    unit_radius_m = radius_m / np.cbrt(force_newton)
    return signals * UNITS, pixel_tractions(force, (x_m, y_m), unit_radius_m, friction, SHAPE, PITCH_M)


def together(one: Scene, other: Scene) -> Scene:
    return one[0] + other[0], one[1] + other[1]


def random_contact(rng: np.random.Generator, sites_m: Floats = SITES_M) -> Scene:
    place_m, radius_m = rng.uniform(-3e-3, 3e-3, 2), rng.uniform(1.5e-3, 3e-3)
    return contact(place_m, radius_m, rng.uniform(0.2, 0.9), direction=rng.uniform(0.0, 2.0 * np.pi), sites_m=sites_m)


def with_gains(scene: Scene, gain_std: float, rng: np.random.Generator) -> Scene:
    return scene[0] * (1.0 + gain_std * rng.standard_normal(scene[0].shape)), scene[1]


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
HEALTHY: dict[str, Callable[[np.random.Generator], Scene]] = {
    "centre": lambda rng: contact((0.0, 0.0), 2.5e-3, rng.uniform(0.2, 0.9)),
    "border": lambda rng: contact((6.4e-3, rng.uniform(-2e-3, 2e-3)), 2.5e-3, rng.uniform(0.2, 0.9)),
    "two": lambda rng: together(
        contact(rng.uniform([-4.3e-3, -1e-3], [-2.3e-3, 1e-3]), rng.uniform(1.5e-3, 2.2e-3), rng.uniform(0.2, 0.9)),
        contact(rng.uniform([2.3e-3, -1e-3], [4.3e-3, 1e-3]), rng.uniform(1.5e-3, 2.2e-3), rng.uniform(0.2, 0.9)),
    ),
    "random": random_contact,
    "a < 1.5": SCENES["a < 1.5"],
}
FAILURES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "light next to heavy": lambda _: together(contact((-2.4e-3, 0.0)), contact((3.4e-3, 0.0), force_newton=0.1)),
    "light, 5 % of heavy": lambda _: together(contact((-2.4e-3, 0.0)), contact((3.4e-3, 0.0), force_newton=0.05)),
    "mu .65, told .5": lambda _: contact((0.0, 0.0), stick_ratio=1e-3, friction=0.65),
    "mu .35, told .5": lambda _: contact((0.0, 0.0), stick_ratio=1e-3, friction=0.35),
    "adhesion .1 p0": lambda _: adhesive(0.1),
    "adhesion .3 p0": lambda _: adhesive(0.3),
    "gains 2 %, untold": lambda rng: with_gains(contact((0.0, 0.0)), 0.02, rng),
    "gains 5 %, untold": lambda rng: with_gains(contact((0.0, 0.0)), 0.05, rng),
    "depth 5 % more": lambda _: contact((0.0, 0.0), depth_m=1.05 * DEPTH_M),
    "depth 10 % more": lambda _: contact((0.0, 0.0), depth_m=1.1 * DEPTH_M),
}


def frame_of(scene: Scene, decibel: float, rng: np.random.Generator) -> Scene:
    """Scaled to a ratio of total rms to noise, with noise."""
    signals, traction = scene
    scale = NOISE_STD * 10 ** (decibel / 20) / float(np.sqrt(np.mean(signals**2)))
    noisy = signals * scale + NOISE_STD * rng.standard_normal(signals.shape)
    return noisy, traction * scale


def error(found: Floats, truth: Floats) -> float:
    return float(np.linalg.norm(found.reshape(truth.shape) - truth) / np.linalg.norm(truth))


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


def layouts(draws: int) -> None:
    """Print errors at the same places of the surface for sites that form no grid."""
    half_m = 16 * PITCH_M
    y, x = np.divmod(np.arange(26 * 22), 22)
    hexagons = np.column_stack([x + y % 2 / 2, y * np.sqrt(0.75)]) * 0.65e-3 - half_m
    places = {
        "random 400": np.random.default_rng(0).uniform(-half_m, half_m, (400, 2)),
        "hexagonal": hexagons[(np.abs(hexagons) < half_m).all(axis=1)],
    }
    print(f"\nrandom contacts under other sites\n{'layout':15} {'dB':>3}   linear mu known")
    for name, sites_m in places.items():
        linear = OpenPlaneDecoder(SKIN, sites_m, DEPTH_M, NOISE_STD, query_positions_m=SITES_M)
        decoder = ContactDecoder(linear, FRICTION)
        for decibel in LEVELS_DB:
            rng = np.random.default_rng(6)
            rows = []
            for _ in range(draws):
                signals, truth = frame_of(random_contact(rng, sites_m), decibel, rng)
                decoder.reset()
                rows.append([error(each.decode(signals).traction_pascal, truth) for each in (linear, decoder)])
            print(f"{name} {len(sites_m):4} {decibel:3}", *(f"{value:8.3f}" for value in np.mean(rows, axis=0)))


def dead_sites(linear: OpenPlaneDecoder, decoder: ContactDecoder, draws: int) -> None:
    print("\n200 of 1024 sites dead: error over that of a healthy skin, linear and mu known")
    for decibel in LEVELS_DB:
        rng = np.random.default_rng(7)
        rows = []
        for _ in range(draws):
            signals, truth = frame_of(contact((0.0, 0.0)), decibel, rng)
            dead = signals.copy()
            dead[:, rng.permutation(1024)[:200]] = np.nan
            for frame in (signals, dead):
                decoder.reset()
                rows.append([error(each.decode(frame).traction_pascal, truth) for each in (linear, decoder)])
        healthy, lost = np.mean(rows[::2], axis=0), np.mean(rows[1::2], axis=0)
        print(f"{decibel:3}", *(f"{value:6.2f}" for value in lost / healthy))


def honesty(decoders: dict[str, ContactDecoder], draws: int) -> None:
    print("\nrandom contacts: within 1 and 2 sd inside, outside; net force x, y, z: bias in % of f_z, rms z")
    for name, decoder in decoders.items():
        for decibel in LEVELS_DB:
            rng = np.random.default_rng(2)
            within, off, z = [], [], []
            for _ in range(draws):
                signals, truth = frame_of(random_contact(rng), decibel, rng)
                decoder.reset()
                decoded = decoder.decode(signals.reshape(3, *SHAPE))
                sigmas = np.abs(decoded.traction_pascal - truth) / decoded.traction_std_pascal
                pressed = truth[2] > 0.0
                within.append([np.mean(sigmas[:, area] < limit) for area in (pressed, ~pressed) for limit in (1, 2)])
                force = truth.sum(axis=(1, 2)) * PITCH_M**2
                (load,) = decoder.net_loads([np.flatnonzero(truth[2] > 0.3 * truth[2].max())], (0.0, 0.0))
                if load is not None:
                    off.append(100.0 * (load.force_newton - force) / force[2])
                    z.append((load.force_newton - force) / load.force_std_newton)
            shown = [*np.mean(within, axis=0), *np.mean(off, axis=0), *np.sqrt(np.mean(np.square(z), axis=0))]
            print(f"{name:8} {decibel:3}", *(f"{value:7.2f}" for value in shown))


def false_alarms(decoders: dict[str, ContactDecoder], frames: int) -> None:
    """Count healthy frames whose bounds were given up."""
    levels = "".join(f"{decibel:5} dB" for decibel in LEVELS_DB)
    print(f"\nfalse alarms in {frames} healthy frames each\n{'scene':10} {'':8} {levels}")
    alarms, shown = 0, 0
    for scene, make in HEALTHY.items():
        for name, decoder in decoders.items():
            counts = []
            for decibel in LEVELS_DB:
                rng = np.random.default_rng([5, decibel])
                count = 0
                for _ in range(frames):
                    decoder.reset()
                    count += decoder.decode(frame_of(make(rng), decibel, rng)[0]).status != "ok"
                counts.append(count)
            alarms, shown = alarms + sum(counts), shown + frames * len(LEVELS_DB)
            print(f"{scene:10} {name:8}", *(f"{count:7}" for count in counts))
    print(f"together {alarms} of {shown}")


def failures(decoder: ContactDecoder, draws: int) -> None:
    levels = "".join(f"{decibel:16} dB" for decibel in LEVELS_DB)
    print(f"\nwhat is not as assumed: noticed, of {draws} frames, in which way; error\n{'':20}{levels}")
    for name, make in FAILURES.items():
        cells = []
        for decibel in LEVELS_DB:
            rng = np.random.default_rng(3)
            dropped, grown, off = 0, 0, []
            for _ in range(draws):
                signals, truth = frame_of(make(rng), decibel, rng)
                decoder.reset()
                decoded = decoder.decode(signals)
                dropped += decoded.status == "constraint_dropped"
                grown += decoded.status == "ok" and decoded.reason != ""
                off.append(error(decoded.traction_pascal, truth))
            said = f"{dropped} dropped" if dropped else f"{grown} grown" if grown else "unseen"
            cells.append(f"{said}  {np.mean(off):.3f}")
        print(f"{name:20}", *(f"{cell:>18}" for cell in cells))


def resting(linear: OpenPlaneDecoder, decoder: ContactDecoder) -> None:
    """Time frames of a contact that rests, in a burst, after the first ones."""
    print("\nresting contact, us per frame, p50 p99 p99.9: map; map and displacement; the linear map alone")
    rng = np.random.default_rng(8)
    frames = [frame_of(contact((0.0, 0.0)), 20, rng)[0].reshape(3, *SHAPE) for _ in range(40)]
    taken_s: list[list[float]] = [[], [], []]
    decoder.reset()
    for round_ in range(40):
        for frame in frames:
            times_s = [time.perf_counter()]
            decoder.decode(frame)
            times_s.append(time.perf_counter())
            decoder.decode(frame, displacement=True)
            times_s.append(time.perf_counter())
            linear.decode(frame)
            times_s.append(time.perf_counter())
            if round_:
                for kept, spent_s in zip(taken_s, np.diff(times_s), strict=True):
                    kept.append(float(spent_s))
    for kept in taken_s:
        print(*(f"{value * 1e6:6.0f}" for value in np.percentile(kept, [50, 99, 99.9])))


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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=3, help="frames per cell of the tables; 3")
    draws: int = parser.parse_args().draws
    with threadpool_limits(1):
        linear = OpenPlaneDecoder(SKIN, SITES_M, DEPTH_M, NOISE_STD)
        started = time.perf_counter()
        told = ContactDecoder(linear, FRICTION)
        print(f"set-up beyond the linear decoder's: {time.perf_counter() - started:.1f} s")
        decoders = {"mu known": told, "unknown": ContactDecoder(linear)}
        errors(linear, decoders, draws)
        layouts(draws)
        dead_sites(linear, told, draws)
        honesty(decoders, 5 * draws)
        false_alarms(decoders, 4 * draws)
        failures(told, draws)
        resting(linear, told)
        sliding(linear)


if __name__ == "__main__":
    main()
