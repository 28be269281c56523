"""Frames of many equal skins decoded together against one at a time: processor time a frame, by count and by load.

Run it with `OMP_NUM_THREADS=1 python benchmarks/batch_decoding.py [--json]`; it takes a minute. Each frame is that of
another skin of 32 x 32 sites, 30 dB, the contact anywhere. Rows "map" are `OpenPlaneDecoder.decode`, of frames one by
one and of their stack. Rows "group" are frames with contact physics as a decoder in a group reads them: one by one,
and those without a load together. "Followed" is the sequential decoder of one skin, which keeps matrices between
frames. One and together run in turns; the ratio is the median over the turns.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable

import numpy as np
from frame_cost import DECIBEL, DEPTH_M, NU, SITES_M, YOUNGS_PASCAL, Load, rest, sheared, signals
from threadpoolctl import threadpool_limits

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding import OpenPlaneDecoder
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.decoding.skin_decoder import SkinDecoder
from resonator_daemon.elastic import HalfSpace

COUNTS = (1, 4, 16, 64)
SKINS = 64
AREA_M = 2.5e-3  # contacts are within this of the centre, along x and y: none reaches the border of the sites


def in_turns(one: Callable[[], object], together: Callable[[], object], frames: int, turns: int) -> dict[str, float]:
    """Return the median thread time a frame of both in us, and of their ratio."""
    spent = np.zeros((turns + 1, 2))
    for turn in spent:
        for column, work in enumerate((one, together)):
            began = time.thread_time()
            work()
            turn[column] = time.thread_time() - began
    one_us, together_us = np.median(spent[1:], axis=0) / frames * 1e6
    ratio = float(np.median(spent[1:, 0] / spent[1:, 1]))
    return {"one_us": float(one_us), "together_us": float(together_us), "times_as_many": ratio}


def measure() -> dict[str, dict[str, float]]:
    rng = np.random.default_rng(0)
    half_space = HalfSpace(YOUNGS_PASCAL, NU)
    rms = float(np.sqrt(np.mean(signals([Load((0.0, 0.0), (0.0, 0.0, 1.0))]) ** 2)))
    noise_std = np.full((3, len(SITES_M)), rms * 10.0 ** (-DECIBEL / 20.0))
    noise = noise_std * rng.standard_normal((SKINS, *noise_std.shape))
    loads = [Load((x, y), sheared(n)) for n, (x, y) in enumerate(rng.uniform(-AREA_M, AREA_M, (SKINS, 2)).tolist())]
    pressed = np.array([signals([load]) for load in loads]) + noise
    tenth = np.where((np.arange(SKINS) % 10 == 0)[:, None, None], pressed, noise)
    linear = OpenPlaneDecoder(half_space, SITES_M, DEPTH_M, noise_std)
    decoder = SkinDecoder(
        Skin(half_space, SITES_M, DEPTH_M), DecodingOptions(background=False), noise_std, lambda _: None
    )
    found: dict[str, dict[str, float]] = {}

    def together(frames: Floats) -> None:
        noises = np.broadcast_to(noise_std, frames.shape)
        for frame, reading in zip(frames, decoder.decode_untouched(frames, noises), strict=True):
            if reading is None:
                decoder.decode_alone(frame, noise_std)

    for count in COUNTS:
        for scene, frames, turns in (("untouched", noise, 40), ("a tenth pressed", tenth, 10), ("pressed", pressed, 4)):
            some = frames[:count]
            if scene != "a tenth pressed":
                for name, displacement in (("map", False), ("map and displacement", True)):
                    found[f"{name}, {scene}, k = {count}"] = in_turns(
                        lambda some=some, moved=displacement: [linear.decode(f, displacement=moved) for f in some],
                        lambda some=some, moved=displacement: linear.decode(some, displacement=moved),
                        count,
                        40,
                    )
            found[f"group, {scene}, k = {count}"] = in_turns(
                lambda some=some: [decoder.decode_alone(frame, noise_std) for frame in some],
                lambda some=some: together(some),
                count,
                turns,
            )
    at_rest = [signals(rest(0)) + each for each in noise]
    followed_s = []
    for frame in at_rest:
        began = time.thread_time()
        decoder.decode(frame, noise_std)
        followed_s.append(time.thread_time() - began)
    found["followed, at rest"] = {"one_us": float(np.median(followed_s) * 1e6)}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one object")
    given = parser.parse_args()
    with threadpool_limits(1, user_api="blas"):
        found = measure()
    if given.json:
        json.dump(found, sys.stdout)
        return
    print(f"{'us of thread time a frame':42} {'one':>9} {'together':>9} {'x frames/s':>11}")
    for name, row in found.items():
        print(f"{name:42} " + " ".join(f"{value:9.1f}" if value > 10 else f"{value:11.2f}" for value in row.values()))


if __name__ == "__main__":
    main()
