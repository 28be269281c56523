"""Linear decoders side by side: errors by scene, layout and noise; time per frame compared with peers; what goes wrong.

Run it with `python benchmarks/decoding.py [DRAWS]`; `make bench` installs pylops and scikit-image for it. Truth is
closed-form, decibels are of the centred contact, one thread; times are medians over interleaved rounds, (x) the median
of the rounds' ratios to the bare transforms, forth and back, of three 48 x 48 fields in single precision.
"""

import sys
import time

from decoding_errors import SIDE, by_scene, equal_powers, honesty, on_grid, open_plane, wrong_gains
from decoding_scenes import DEPTH_M, LEVELS_DB, NOISE_STD, SKIN, Floats, grid, layouts
from decoding_speed import side_by_side
from threadpoolctl import threadpool_limits

from resonator_daemon.decoding import OpenPlaneDecoder

BIG = 64  # a side; other layouts of so many sites have no symmetry, and matrices of 1.2 GB to find eigenvectors of


def set_up(layout: str, sites_m: Floats, side: int) -> OpenPlaneDecoder:
    started = time.perf_counter()
    queries_m = None if layout == "grid" else grid(side)
    decoder = OpenPlaneDecoder(SKIN, sites_m, DEPTH_M, NOISE_STD, query_positions_m=queries_m)
    print(f"set-up of {layout}, {len(sites_m)} sites: {time.perf_counter() - started:.1f} s", file=sys.stderr)
    return decoder


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 4
    with threadpool_limits(1):
        decoders = {layout: set_up(layout, sites_m, SIDE) for layout, sites_m in layouts(SIDE).items()}
        big = set_up("grid", grid(BIG), BIG)

        print("relative L2 error of the traction, at the pixels of the grid")
        print(f"{'layout':10} sites {'decoder':24} {'scene':8}", *(f"{level:>5} dB" for level in LEVELS_DB))
        for layout, decoder in decoders.items():
            estimates = {"open-plane": open_plane(decoder)}
            if layout == "grid":
                estimates |= {"open-plane, equal powers": equal_powers()} | on_grid(SIDE)
            by_scene(layout, decoder.site_positions_m, SIDE, estimates, draws)
        by_scene("grid", big.site_positions_m, BIG, {"open-plane": open_plane(big)} | on_grid(BIG), draws)
        wrong_gains(decoders["grid"], draws)
        honesty(decoders["grid"], 6 * draws)

        for layout, decoder in decoders.items():
            side_by_side(layout, decoder, SIDE)
        side_by_side("grid", big, BIG)


if __name__ == "__main__":
    main()
