"""Figure of a plan of codes, as SVG, PNG or PDF: the plate with its codes, and the band of each site."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.plate import Plate
from resonator_daemon.view.pages import make_figure

_INCHES: Final = (9.0, 4.5)


def write_code_figure(
    path: Path,
    plate: Plate,
    codes: NDArray[np.int64],
    bands_hz: tuple[NDArray[np.float64], NDArray[np.float64]],
    guard_step: float,
    *,
    has_pilot: bool,
) -> None:
    """Write the figure; its suffix chooses the format.

    Parameters
    ----------
    path, plate, codes
        `codes` (m,) by site.
    bands_hz
        Lowest and highest frequency of each site, each (m,).
    guard_step
        What two tones must be apart, relative.
    has_pilot
        Whether the pilot belongs to it.
    """
    figure = make_figure(_INCHES)
    above, ladder = figure.subplots(1, 2, width_ratios=[1, 1])
    outline_mm = 1e3 * np.vstack([plate.outline_m, plate.outline_m[:1]])
    above.plot(*outline_mm.T, color="0.4", linewidth=1.0)
    above.scatter(*(1e3 * plate.transducers_m.T), marker="s", color="0.4", s=20, label="transducer")
    sites_mm = 1e3 * plate.site_positions_m
    above.scatter(*sites_mm.T, c=codes, cmap="viridis", s=160)
    for (x_mm, y_mm), code in zip(sites_mm, codes.tolist(), strict=True):
        above.annotate(str(code), (x_mm, y_mm), ha="center", va="center", fontsize="x-small", color="white")
    above.set_aspect("equal")
    above.invert_yaxis()
    above.set_xlabel("x, mm")
    above.set_ylabel("y, mm")
    above.set_title("Codes on the plate", fontsize="medium")
    low, high = (1e6 * (band / plate.pilot_hz - 1.0) for band in bands_hz)
    guard = 1e6 * guard_step
    ladder.barh(codes, np.full(len(codes), guard), left=high - guard, height=0.9, color="0.88", label="guard band")
    ladder.barh(codes, high - low, left=low, height=0.6, color="C0", label="reached by forces")
    if has_pilot:
        ladder.axvline(0.0, color="C3", linewidth=1.0, label="pilot")
    ladder.invert_yaxis()
    ladder.locator_params(axis="x", nbins=6)
    ladder.set_xlabel("from the pilot, ppm" if has_pilot else "from 0.1 % above the highest tone, ppm")
    ladder.set_ylabel("code")
    ladder.set_title("Bands", fontsize="medium")
    ladder.legend(fontsize="x-small")
    figure.savefig(path)
