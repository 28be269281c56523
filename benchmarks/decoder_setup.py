"""Set-up time of decoders: from nothing, from the cache, and what importing them takes.

Run it with `python benchmarks/decoder_setup.py [REPEATS]`. Each row is one skin and one set of options; times are the
least of some repeats, in seconds of one thread (BLAS included) and of the clock. "From the cache" is all that
`set_up` does when it finds a file: hash of code and libraries, reading, checksum, unpickling.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from decoding_scenes import DEPTH_M, NOISE_STD, grid
from threadpoolctl import threadpool_limits

from resonator_daemon.decoding.prior import Prior
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.decoding.skin_decoder import SkinDecoder
from resonator_daemon.decoding.streaming import set_up
from resonator_daemon.elastic import HalfSpace
from resonator_daemon.plate import load_plate

YOUNGS_PASCAL, POISSON_RATIO, MU = 2e5, 0.5, 0.5
BIG = 64  # a side
IMPORT = (
    "import time; t = time.process_time(); import resonator_daemon.decoding.streaming; print(time.process_time() - t)"
)


def shipped(name: str) -> Skin:
    plate = load_plate(name)
    if plate.skin is None:
        raise ValueError(f"{name} has no skin")
    return Skin(
        HalfSpace(plate.skin.youngs_modulus_pascal, plate.skin.poisson_ratio),
        plate.site_positions_m,
        plate.skin.depth_m,
        plate.skin.gain_std,
        Prior(plate.skin.correlation_length_m, plate.skin.tangential_ratio),
    )


def least(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Thread time and time of the clock."""
    spent = []
    for _ in range(repeats):
        started = time.thread_time(), time.perf_counter()
        work()
        spent.append((time.thread_time() - started[0], time.perf_counter() - started[1]))
    thread, clock = np.min(spent, axis=0)
    return float(thread), float(clock)


def row(name: str, skin: Skin, wanted: DecodingOptions, repeats: int) -> None:
    noise_std = np.full((3, len(skin.site_positions_m)), NOISE_STD)
    steps: list[tuple[str, float]] = []

    def from_nothing() -> None:
        steps.clear()
        SkinDecoder(skin, wanted, noise_std, lambda step: steps.append((step, time.thread_time())))
        steps.append(("", time.thread_time()))

    with tempfile.TemporaryDirectory() as directory:
        os.environ["CACHE_DIRECTORY"] = directory
        nothing = least(from_nothing, repeats)
        set_up(skin, wanted, noise_std, lambda _: None)
        cached = least(lambda: set_up(skin, wanted, noise_std, lambda _: None), max(repeats, 3))
        (file,) = Path(directory).iterdir()
        size_mb = file.stat().st_size / 1e6
    options = f"mu {wanted.friction_coefficient}, displacement {'on' if wanted.displacement else 'off'}"
    parts = ", ".join(f"{step} {after - before:.2f}" for (step, before), (_, after) in pairwise(steps))
    print(
        f"{name:14} {options:28} {nothing[0]:8.2f} {nothing[1]:8.2f} {cached[0]:8.3f} {cached[1]:8.3f} {size_mb:6.0f}",
        f"  {parts}",
        flush=True,
    )


def main() -> None:
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    print(f"{'':43} {'from nothing, s':>17} {'from cache, s':>17}   file")
    print(f"{'':43} {'thread':>8} {'clock':>8} {'thread':>8} {'clock':>8} {'MB':>6}   thread time of each part")
    with threadpool_limits(1):
        for name in ("skin32", "fingertip400"):
            for mu, displacement in product((MU, None), (True, False)):
                row(name, shipped(name), DecodingOptions(friction_coefficient=mu, displacement=displacement), repeats)
        big = Skin(HalfSpace(YOUNGS_PASCAL, POISSON_RATIO), grid(BIG), DEPTH_M)
        row(f"{BIG} x {BIG}", big, DecodingOptions(), 1)
    imports = [
        float(subprocess.run([sys.executable, "-c", IMPORT], check=True, capture_output=True, text=True).stdout)
        for _ in range(repeats)
    ]
    print(f"import of the decoding package, with numpy and scipy: {min(imports):.2f} s of processor time")


if __name__ == "__main__":
    main()
