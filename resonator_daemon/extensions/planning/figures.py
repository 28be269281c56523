"""Pictures of a plan in files: the spectra of a sensor set, and the bands of codes on a plate."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.plate import Plate
from resonator_daemon.tools.view.words import make_figure

_PANELS_IN_A_ROW: Final = 4
_PANEL_INCHES: Final = (2.6, 3.4)

_CODE_INCHES: Final = (9.0, 4.5)


def write_density_figure(
    path: Path, titles: Sequence[str], power: NDArray[np.float64], omega_rad_per_m: NDArray[np.float64], title: str
) -> None:
    """Write one panel for each spectrum, and below it its profiles along the lines through 0 at 0, 45 and 90 degrees.

    Parameters
    ----------
    path
        Its suffix chooses the format: .svg, .png or .pdf.
    titles
        One for each panel.
    power
        Spectra, shape (n, m, m), rows along omega_y, which points downwards; NaN where one has no value, as at 0.
        Each panel is scaled to its own maximum.
    omega_rad_per_m
        Frequencies of rows and columns, m of them, odd, increasing, symmetric about 0.
    title
        Of the whole figure.
    """
    columns = min(len(titles), _PANELS_IN_A_ROW)
    bands = math.ceil(len(titles) / columns)
    width, height = _PANEL_INCHES
    figure = make_figure((width * columns, height * bands + 0.5))
    figure.suptitle(title, fontsize="medium")
    axes = figure.subplots(2 * bands, columns, squeeze=False, height_ratios=[3, 1] * bands)
    omega = omega_rad_per_m * 1e-3
    scaled = power / np.nanmax(power, axis=(1, 2), keepdims=True)
    middle, edges = len(omega) // 2, (omega[0], omega[-1], omega[-1], omega[0])
    for index, (name, spectrum) in enumerate(zip(titles, scaled, strict=True)):
        band, column = divmod(index, columns)
        density, profile = axes[2 * band, column], axes[2 * band + 1, column]
        density.imshow(_filled(spectrum), cmap="Greys", vmin=0.0, vmax=1.0, origin="upper", extent=edges)
        density.set_title(name, fontsize="small")
        density.tick_params(labelbottom=False)
        for angle, along, values in (
            ("0", omega, spectrum[middle]),
            ("45", omega * math.sqrt(2.0), np.diagonal(spectrum)),
            ("90", omega, spectrum[:, middle]),
        ):
            profile.plot(along, values, linewidth=1.0, label=f"{angle}°")
        profile.set_xlim(omega[0], omega[-1])
        profile.set_ylim(0.0, 1.05)
        profile.set_xlabel("ω_x, profiles: |ω|, rad/mm", fontsize="x-small")
    axes[0, 0].set_ylabel("ω_y, rad/mm", fontsize="x-small")
    axes[1, 0].legend(fontsize="xx-small")
    for unused in range(len(titles), bands * columns):
        band, column = divmod(unused, columns)
        axes[2 * band, column].set_axis_off()
        axes[2 * band + 1, column].set_axis_off()
    figure.savefig(path)


def _filled(spectrum: NDArray[np.float64]) -> NDArray[np.float64]:
    """Put the mean of its neighbours where a pixel has no value, which would be drawn as none at all."""
    filled = spectrum.copy()
    for row, column in np.argwhere(np.isnan(spectrum)):
        filled[row, column] = np.nanmean(spectrum[row - 1 : row + 2, column - 1 : column + 2])
    return filled


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
    figure = make_figure(_CODE_INCHES)
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
