"""Draw the picture of the README: a sheared press on `fingertip400`, decoded from 400 scattered sites, and the truth.

`python docs/figures/fingertip.py` draws it alone. It prints the errors that the picture shows.
"""

import argparse
import os
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle, PathPatch, Polygon
from matplotlib.path import Path as Curve
from numpy.typing import NDArray

from resonator_daemon.base.plate import load_plate
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.contact_physics.decoder import ContactDecoder
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from simulators.contact import hertz_parts, point_tractions, pressed_signals
from simulators.pressing import RADIUS_M_AT_1_NEWTON
from simulators.skin_plate import GAIN_ERROR, SIGNAL_TO_NOISE_DB

Floats = NDArray[np.float64]

CENTRE_M = (-0.9e-3, 1.2e-3)
FRICTION, SHEAR, DIRECTION = 0.5, 0.85, np.radians(35.0)  # shear: of what friction can carry
FORCE_NEWTON = (
    SHEAR * FRICTION * float(np.cos(DIRECTION)),
    SHEAR * FRICTION * float(np.sin(DIRECTION)),
    1.0,
)
PIXELS_PER_MM, PIXELS_PER_ARROW = 5, 3
WEAK = 0.05  # of the greatest pressure: shear that is not drawn


def fingertip(folder: Path) -> None:
    plate = load_plate("fingertip400")
    if plate.skin is None:
        raise ValueError("plate fingertip400 has no [skin]")
    skin, sites = plate.skin, plate.site_positions_m
    exact = pressed_signals(
        sites,
        skin.depth_m,
        skin.youngs_modulus_pascal,
        skin.poisson_ratio,
        CENTRE_M,
        RADIUS_M_AT_1_NEWTON,
        FRICTION,
        FORCE_NEWTON,
    ) * np.array([[1.5 / skin.youngs_modulus_pascal], [1.0], [1.0]])
    rng = np.random.default_rng(1)
    noise_std = float(np.sqrt(np.mean(exact**2))) * 10.0 ** (-SIGNAL_TO_NOISE_DB / 20.0)
    gains = rng.normal(1.0, GAIN_ERROR, exact.shape)  # unknown to the decoders
    signals = exact * gains + noise_std * rng.standard_normal(exact.shape)

    low, high = plate.outline_m.min(axis=0), plate.outline_m.max(axis=0)
    nx, ny = (round(PIXELS_PER_MM * 1e3 * length) for length in high - low)
    axes_m = (low[i] + (np.arange(n) + 0.5) / (PIXELS_PER_MM * 1e3) for i, n in enumerate((nx, ny)))
    places = np.stack(np.meshgrid(*axes_m), axis=-1).reshape(-1, 2)

    half_space = HalfSpace(skin.youngs_modulus_pascal, skin.poisson_ratio)
    linear = OpenPlaneDecoder(half_space, sites, skin.depth_m, noise_std, query_positions_m=places)
    true = point_tractions(FORCE_NEWTON, CENTRE_M, RADIUS_M_AT_1_NEWTON, FRICTION, places)
    panels = {}
    for name, decoder in (("open plane", linear), ("contact physics", ContactDecoder(linear))):
        traction = decoder.decode(signals).traction_pascal
        error = float(np.linalg.norm(traction - true) / np.linalg.norm(true))
        print(f"fingertip400: traction by {name} differs from the truth by {error:.3f} (relative L2)")
        panels[f"{name}, error {100 * error:.0f} %"] = traction
    panels["truth"] = true

    figure = Figure(figsize=(11, 3.8), layout="constrained")
    all_axes = figure.subplots(1, 4, sharex=True, sharey=True)
    draw_sites(all_axes[0], plate.outline_m, sites)
    full_kpa = 1e-3 * float(true[2].max())
    for axes, (name, traction) in zip(all_axes[1:], panels.items(), strict=True):
        shown = draw_traction(axes, plate.outline_m, traction.reshape(3, ny, nx), (low, high), full_kpa)
        axes.set_title(name, fontsize="medium")
    figure.colorbar(shown, ax=all_axes, shrink=0.85, pad=0.01, label="pressure, kPa")
    for axes in all_axes:
        axes.set(xlabel="x, mm", xticks=[-5, 0, 5], yticks=[-5, 0, 5], xlim=(-7.2, 7.2), ylim=(9.2, -9.2))
        axes.spines[:].set_visible(False)
    all_axes[0].set_ylabel("y, mm")
    figure.savefig(folder / "fingertip400.svg")


def draw_sites(axes: Axes, outline_m: Floats, sites_m: Floats) -> None:
    """Sites, and the rims of the contact and of what sticks in it."""
    axes.add_patch(Polygon(outline_m * 1e3, facecolor="0.95", edgecolor="0.4"))
    axes.plot(*(sites_m * 1e3).T, ".", markersize=2.5, color="tab:blue")
    radii_m = hertz_parts(FORCE_NEWTON, RADIUS_M_AT_1_NEWTON, FRICTION)[0]
    centre = (CENTRE_M[0] * 1e3, CENTRE_M[1] * 1e3)
    for radius, style in zip(radii_m * 1e3, ("-", "--"), strict=True):
        axes.add_patch(Circle(centre, radius, fill=False, linestyle=style, color="tab:red"))
    axes.set_aspect("equal")
    axes.set_title("400 sites under 1 mm of skin", fontsize="medium")


def draw_traction(
    axes: Axes, outline_m: Floats, traction_pascal: Floats, corners_m: tuple[Floats, Floats], full_kpa: float
) -> AxesImage:
    """Pressure in colours and shear as arrows, inside the outline."""
    (x0, y0), (x1, y1) = (corner * 1e3 for corner in corners_m)
    kpa = traction_pascal * 1e-3
    shown = axes.imshow(kpa[2], cmap="viridis", vmin=0.0, vmax=full_kpa, origin="upper", extent=(x0, x1, y1, y0))
    border = PathPatch(Curve(np.vstack([outline_m, outline_m[:1]]) * 1e3), transform=axes.transData, fill=False)
    axes.add_patch(border)
    shown.set_clip_path(border)
    y, x = np.divmod(np.arange(kpa[2].size), kpa.shape[2])
    shear = kpa[:2].reshape(2, -1)
    arrow = (x % PIXELS_PER_ARROW == 0) & (y % PIXELS_PER_ARROW == 0) & (np.hypot(*shear) > WEAK * full_kpa)
    places = (x0 + (x[arrow] + 0.5) / PIXELS_PER_MM, y0 + (y[arrow] + 0.5) / PIXELS_PER_MM)
    axes.quiver(*places, *shear[:, arrow], color="white", scale=5.0 * full_kpa, width=0.008, angles="xy")
    return shown


def main() -> None:
    matplotlib.rcParams["svg.hashsalt"] = "resonatord"  # the same drawing is the same file
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
    parser = argparse.ArgumentParser(description="Draw the picture of the README.")
    parser.add_argument(
        "--folder", type=Path, default=Path(__file__).parent, help="where to (default: the folder of this file)"
    )
    fingertip(parser.parse_args().folder)


if __name__ == "__main__":
    main()
