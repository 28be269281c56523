"""Processor time of a whole decoded frame of skin32, by scene: map, contacts, rebuilds, in ms of thread time.

Run it with `python benchmarks/frame_cost.py [--frames N] [--scene WORD]... [--json]`; `--frames 200`, the default,
takes about a minute. Signals are closed-form, with noise 30 dB below those of 1 N and gain errors of 1 %. Frames are
decoded one after the other as the daemon does, displacement included. A rebuild that a frame asks for runs at once and
counts for that frame. Cold frames are those of the decoding service for groups, each decoded alone; all their time is
listed under map. One thread of linear algebra. `loop` is the time of a fixed piece of numpy in the same run: divide by
it to compare computers.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.decoding.skin_decoder import SkinDecoder
from resonator_daemon.elastic import HalfSpace
from simulators.contact import hertz_parts
from simulators.half_space_fields import hertz_fields

YOUNGS_PASCAL, NU, DEPTH_M, PITCH_M = 2e5, 0.5, 1e-3, 4e-4
RADIUS_M, FRICTION = 2.5e-3, 0.5  # of contact at 1 N
DECIBEL, GAIN_ERROR = 30.0, 0.01
WARM_UP = 10  # frames, in which contacts begin and matrices are built
AXIS_M = (np.arange(32) - 15.5) * PITCH_M
SITES_M = np.stack(np.meshgrid(AXIS_M, AXIS_M), axis=-1).reshape(-1, 2)
TO_TRIPLE = np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])


class Load(NamedTuple):
    """A contact in one frame."""

    centre_m: tuple[float, float]
    force_newton: tuple[float, float, float]


Path = Callable[[int], list[Load]]  # frame number to the contacts of the frame


class Scene(NamedTuple):
    """What happens on the skin."""

    loads: Path
    friction_coefficient: float | None = None  # that the decoder is given
    cold: bool = False


def swing(frame: int, step_m: float, reach_m: float) -> float:
    """Coordinate of a point that goes back and forth by a step each frame."""
    phase = (frame * step_m) % (4.0 * reach_m)
    return phase - reach_m if phase < 2.0 * reach_m else 3.0 * reach_m - phase


def sheared(
    frame: int, share: float = 0.6, normal_newton: float = 1.0, direction: float = 0.6
) -> tuple[float, float, float]:
    """Force whose shear varies slowly by a third about a share of the largest that friction bears."""
    shear = FRICTION * normal_newton * share * (1.0 + np.sin(frame / 15.0) / 3.0)
    return shear * np.cos(direction), shear * np.sin(direction), normal_newton


def one(step_m: float, reach_m: float = 3e-3) -> Path:
    def loads(frame: int) -> list[Load]:
        return [Load((swing(frame, step_m, reach_m), 0.4e-3), sheared(frame))]

    return loads


def rest(_frame: int) -> list[Load]:
    return [Load((0.7e-3, 0.4e-3), sheared(0))]


def pressed(_frame: int) -> list[Load]:
    return [Load((0.7e-3, 0.4e-3), (0.0, 0.0, 1.0))]


def two(step_m: float) -> Path:
    def loads(frame: int) -> list[Load]:
        aside_m = swing(frame, step_m, 1e-3)
        return [
            Load((-3e-3 + aside_m, -1e-3), sheared(frame, normal_newton=0.5)),
            Load((3e-3, 1.5e-3 + aside_m), sheared(frame, 0.4, 0.4, 1.0)),
        ]

    return loads


SCENES: dict[str, Scene] = {
    "nothing": Scene(lambda _: []),
    "sheared, sliding .03 mm a frame": Scene(one(3e-5)),
    "sheared, sliding, mu given": Scene(one(3e-5), FRICTION),
    "sheared, at rest": Scene(rest),
    "sheared, at rest, mu given": Scene(rest, FRICTION),
    "pressed, no shear": Scene(pressed),
    "two contacts": Scene(two(1e-5)),
    "moving .16 mm a frame": Scene(one(1.6e-4)),
    "cold": Scene(one(1.6e-4), cold=True),
}


def signals(loads: list[Load]) -> Floats:
    """Return the signals (3, n) of contacts, without noise."""
    total = np.zeros((3, len(SITES_M)))
    for load in loads:
        radii, forces = hertz_parts(load.force_newton, RADIUS_M, FRICTION)
        fields = hertz_fields(SITES_M - load.centre_m, DEPTH_M, radii, YOUNGS_PASCAL, NU)
        total += np.einsum("kf,kfsn->sn", forces, fields)
    return np.asarray(total * TO_TRIPLE, np.float64)


def reference_loop_ms() -> float:
    """Thread time of a fixed piece of numpy work, median of 20."""
    rng = np.random.default_rng(0)
    matrix, vector = rng.standard_normal((300, 600)).astype(np.float32), rng.standard_normal(600).astype(np.float32)
    spent = []
    for _ in range(20):
        began = time.thread_time()
        for _ in range(20):
            np.exp(-np.abs(matrix @ vector)).sum()
        spent.append(time.thread_time() - began)
    return 1e3 * float(np.median(spent))


def measure(scene: Scene, frames: int) -> tuple[Floats, int]:
    """Return thread time of map, contacts and rebuilds of each frame (frames, 3) in ms, and how many rebuilds."""
    rng = np.random.default_rng(0)
    rms = float(np.sqrt(np.mean(signals([Load((0.0, 0.0), (0.0, 0.0, 1.0))]) ** 2)))
    noise_std = np.full((3, len(SITES_M)), rms * 10.0 ** (-DECIBEL / 20.0))
    gains = 1.0 + GAIN_ERROR * rng.standard_normal(noise_std.shape)
    skin = Skin(HalfSpace(YOUNGS_PASCAL, NU), SITES_M, DEPTH_M)
    options = DecodingOptions(friction_coefficient=scene.friction_coefficient, background=not scene.cold)
    decoder = SkinDecoder(skin, options, noise_std, lambda _: None)
    spent_ms, rebuilds = np.zeros((frames, 3)), 0
    for number in range(-WARM_UP, frames):
        frame = signals(scene.loads(number)) * gains + noise_std * rng.standard_normal(noise_std.shape)
        marks = [time.thread_time()]
        if scene.cold:
            decoder.decode_alone(frame, noise_std)
            marks += [time.thread_time()] * 3
        else:
            decoded = decoder.decode_map(frame, noise_std)
            marks.append(time.thread_time())
            decoder.read_contacts(decoded)
            marks.append(time.thread_time())
            rebuilt = decoder.rebuild()
            marks.append(time.thread_time())
            rebuilds += bool(rebuilt) and number >= 0
        if number >= 0:
            spent_ms[number] = 1e3 * np.diff(marks)
    return spent_ms, rebuilds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200, help="of each scene")
    parser.add_argument("--scene", action="append", default=[], help="part of a scene's name; default: all scenes")
    parser.add_argument("--json", action="store_true", help="one object, ms by scene and stage")
    given = parser.parse_args()
    found: dict[str, dict[str, float]] = {}
    with threadpool_limits(1, user_api="blas"):
        loop_ms = reference_loop_ms()
        print(f"{'ms of thread time a frame':34} median    p95   mean =   map + contacts + rebuilds", file=sys.stderr)
        for name, scene in SCENES.items():
            if given.scene and not any(word in name for word in given.scene):
                continue
            spent_ms, rebuilds = measure(scene, given.frames)
            total = spent_ms[:, :2].sum(axis=1)
            row = {
                "median": float(np.median(total)),
                "p95": float(np.percentile(total, 95)),
                "mean": float(spent_ms.sum(axis=1).mean()),
                **dict(zip(("map", "contacts", "rebuilds"), spent_ms.mean(axis=0).tolist(), strict=True)),
                "rebuild_count": rebuilds,
            }
            found[name] = row
            line = (
                f"{name:34} {row['median']:6.2f} {row['p95']:6.2f} {row['mean']:6.2f} "
                f"  {row['map']:5.2f}   {row['contacts']:8.2f}   {row['rebuilds']:8.2f} ({rebuilds})"
            )
            print(line, file=sys.stderr if given.json else sys.stdout, flush=True)
    if given.json:
        print(json.dumps({"loop": loop_ms, "scenes": found}))
    else:
        print(f"loop: {loop_ms:.3f} ms; median and p95 without rebuilds, mean with them")


if __name__ == "__main__":
    main()
