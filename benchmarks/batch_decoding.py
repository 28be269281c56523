"""Frames of many equal skins decoded one at a time from cold, in batches, and followed: thread time and memory.

Run it with `OMP_NUM_THREADS=1 python benchmarks/batch_decoding.py [--json]`; it takes one to two minutes. Each frame is
that of one of k skins of 32 x 32 sites, 30 dB, the contact anywhere, its shear changing from frame to frame. "Cold" and
"batch" are frames with contact physics as a decoder of a group reads them: one at a time, and those without a load
together. "Followed" is a decoder for each skin, all with the same matrices, skin after skin. Rows "map" are
`OpenPlaneDecoder.decode`, of frames one by one and of their stack. Columns are measured in turns; "times" is the median
over the turns of frames per second over cold. Memory is that of the arrays in the state of a followed skin, the mean
over skins; matrices, which they share, have a row of their own.
"""

import argparse
import json
import pickle
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
from frame_cost import DECIBEL, DEPTH_M, NU, SITES_M, YOUNGS_PASCAL, Load, sheared, signals
from threadpoolctl import threadpool_limits

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding import OpenPlaneDecoder
from resonator_daemon.decoding.equal_skins import EqualSkins
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.decoding.skin_decoder import SkinDecoder
from resonator_daemon.elastic import HalfSpace

COUNTS = (1, 4, 16, 64)
SKINS = 64
FRAMES = 6  # of each skin
WARM_UP = 2  # of them, in which contacts begin and matrices are built
AREA_M = 2.5e-3  # contacts are within this of the centre, along x and y: none reaches the border of the sites
MAP_TURNS = 40

Decode = Callable[[Floats], object]  # frames (k, 3, n), one of each skin


def in_turns(decodings: dict[str, Decode], frames: Floats) -> dict[str, float]:
    """Return the median thread time a frame of each in us, over frames (turns, k, 3, n), and ratios to the first."""
    spent = np.zeros((len(frames), len(decodings)))
    for turn, stack in enumerate(frames):
        for column, decode in enumerate(decodings.values()):
            began = time.thread_time()
            decode(stack)
            spent[turn, column] = time.thread_time() - began
    kept = spent[WARM_UP:]
    medians = np.median(kept, axis=0) / frames.shape[1] * 1e6
    ratios = np.median(kept[:, :1] / kept, axis=0)
    found = {f"{name}_us": float(value) for name, value in zip(decodings, medians, strict=True)}
    return found | {f"{name}_times": float(r) for name, r in list(zip(decodings, ratios, strict=True))[1:]}


def arrays(decoder: SkinDecoder) -> Iterator[tuple[int, int]]:
    """Yield address and bytes of each array of a decoder."""
    buffers: list[pickle.PickleBuffer] = []
    pickle.dumps(decoder, protocol=5, buffer_callback=buffers.append)
    for buffer in buffers:
        yield np.frombuffer(buffer.raw(), np.uint8).ctypes.data, buffer.raw().nbytes


def megabytes(decoder: SkinDecoder, shared: frozenset[int]) -> float:
    return sum(size for address, size in arrays(decoder) if address not in shared) / 1e6


def measure() -> dict[str, dict[str, float]]:
    rng = np.random.default_rng(0)
    half_space = HalfSpace(YOUNGS_PASCAL, NU)
    rms = float(np.sqrt(np.mean(signals([Load((0.0, 0.0), (0.0, 0.0, 1.0))]) ** 2)))
    noise_std = np.full((3, len(SITES_M)), rms * 10.0 ** (-DECIBEL / 20.0))
    centres_m = rng.uniform(-AREA_M, AREA_M, (SKINS, 2)).tolist()
    untouched = noise_std * rng.standard_normal((FRAMES, SKINS, *noise_std.shape))
    pressed = untouched + np.array(
        [
            [signals([Load((x, y), sheared(skin + turn))]) for skin, (x, y) in enumerate(centres_m)]
            for turn in range(FRAMES)
        ]
    )
    tenth = np.where((np.arange(SKINS) % 10 == 0)[:, None, None], pressed, untouched)
    linear = OpenPlaneDecoder(half_space, SITES_M, DEPTH_M, noise_std)
    skin, options, skins = Skin(half_space, SITES_M, DEPTH_M), DecodingOptions(background=False), EqualSkins()
    decoder = skins.set_up(skin, options, noise_std, lambda _: None)

    def cold(stack: Floats) -> None:
        for frame in stack:
            decoder.decode_alone(frame, noise_std)

    def batch(stack: Floats) -> None:
        for frame, reading in zip(
            stack, decoder.decode_untouched(stack, np.broadcast_to(noise_std, stack.shape)), strict=True
        ):
            if reading is None:
                decoder.decode_alone(frame, noise_std)

    found = {"matrices": {"followed_mb": megabytes(decoder, frozenset())}}
    shared = frozenset(address for address, _ in arrays(decoder))
    for count in COUNTS:
        for scene, frames in (("untouched", untouched), ("a tenth pressed", tenth), ("all pressed", pressed)):
            some = frames[:, :count]
            if scene != "a tenth pressed":
                maps: dict[str, Decode] = {
                    "cold": lambda stack: [linear.decode(frame) for frame in stack],
                    "batch": linear.decode,
                }
                found[f"map, {scene}, k = {count}"] = in_turns(maps, some[np.arange(MAP_TURNS) % FRAMES])
            decoders = [skins.set_up(skin, options, noise_std, lambda _: None) for _ in range(count)]
            for stack in some[:WARM_UP]:
                for each, frame in zip(decoders, stack, strict=True):
                    each.decode(frame, noise_std)

            def followed(stack: Floats, decoders=decoders) -> None:  # type: ignore[no-untyped-def]
                for each, frame in zip(decoders, stack, strict=True):
                    each.decode(frame, noise_std)

            row = in_turns({"cold": cold, "batch": batch, "followed": followed}, some)
            found[f"{scene}, k = {count}"] = row | {
                "followed_mb": float(np.mean([megabytes(each, shared) for each in decoders]))
            }
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
    columns = ("cold_us", "batch_us", "followed_us", "batch_times", "followed_times", "followed_mb")
    print(f"{'us of thread time a frame':28}" + "".join(f"{name:>15}" for name in columns))
    for name, row in found.items():
        print(
            f"{name:28}"
            + "".join(f"{row[key]:15.{0 if key.endswith('us') else 1}f}" if key in row else " " * 15 for key in columns)
        )


if __name__ == "__main__":
    main()
