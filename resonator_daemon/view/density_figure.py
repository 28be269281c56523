"""Figures of power spectra over the plane of spatial frequencies, as SVG, PNG or PDF; dark is strong."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.view.pages import make_figure

_PANELS_IN_A_ROW: Final = 4
_PANEL_INCHES: Final = (2.6, 3.4)


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
