"""Draw the figures of docs/research/reproduction.md: the paper's Figs 2-13, with the corrected matrices.

Run it with `make figures`. It prints the figures that the page states.
"""

import argparse
import os
from pathlib import Path

import matplotlib
import numpy as np
from decoders import Decoders
from matplotlib.figure import Figure
from scene import (
    BODY,
    COUNT,
    CURVATURE_RADIUS_M,
    DEPTH_M,
    EXTENT_MM,
    FINER,
    FRICTION,
    LOAD_NEWTON,
    NOISE_DB,
    PITCH_M,
    STICK_RATIO,
    noise,
    noise_rms,
)
from scene import signals as signals_in_closed_form
from section4 import errors_by_noise, figures_9_to_12
from stick_radius import stick_radius

from resonator_daemon.estimate.elastic.contact import FrictionalContact, paraboloid
from resonator_daemon.estimate.elastic.fields import SurfaceFields
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance

PANELS = {
    "Fig. 2: p_n": ("p_n", [0]),
    "Fig. 3: eps_xx": ("strain", [0]),
    "Fig. 4: eps_zz": ("strain", [2]),
    "Fig. 5: eps_xy": ("strain", [3]),
    "Fig. 6: eps_xz": ("strain", [4]),
    "Fig. 7: p_n, eps_xz, eps_yz": ("sensor", [0, 1, 2]),
}


def power_spectra(folder: Path) -> None:
    """Figs 2-7: squared norm of each row, over a square of frequencies."""
    omega = np.linspace(-4.0, 4.0, 121) / DEPTH_M
    wx, wy = np.meshgrid(omega, omega)
    spectra = []
    for output, rows in PANELS.values():
        matrix = BODY.transfer_matrix(output, "traction", wx, wy, DEPTH_M)
        spectra.append((np.abs(matrix[..., rows, :]) ** 2).sum(axis=(-2, -1)))
        spectra[-1][60, 60] = np.nan  # every direction has a limit of its own there
    figure = Figure(figsize=(10.4, 7.3), layout="constrained")
    figure.suptitle(
        f"Power spectra per traction, depth {DEPTH_M * 1e3:g} mm, Poisson's ratio {BODY.poisson_ratio:g}; below them, "
        "profiles at 0, 45 and 90 degrees",
        fontsize="medium",
    )
    axes = figure.subplots(4, 3, height_ratios=[3, 1] * 2)
    omega = omega * 1e-3
    for index, (name, spectrum) in enumerate(zip(PANELS, spectra, strict=True)):
        band, column = divmod(index, 3)
        density, profile = axes[2 * band, column], axes[2 * band + 1, column]
        scaled = spectrum / np.nanmax(spectrum)
        density.imshow(scaled, cmap="Greys", vmin=0.0, extent=(omega[0], omega[-1], omega[-1], omega[0]))
        density.set_title(name, fontsize="small")
        for angle, along, values in (
            ("0", omega, scaled[60]),
            ("45", omega * np.sqrt(2.0), np.diagonal(scaled)),
            ("90", omega, scaled[:, 60]),
        ):
            profile.plot(along, values, linewidth=1.0, label=f"{angle}°")
        profile.set_xlim(omega[0], omega[-1])
    axes[0, 0].set_ylabel("omega_y, rad/mm", fontsize="small")
    axes[-1, 0].set_xlabel("omega_x, profiles: |omega|, rad/mm", fontsize="small")
    axes[1, 0].legend(fontsize="xx-small")
    figure.savefig(folder / "power-spectra.svg")


def contact(count: int, pitch_m: float) -> FrictionalContact:
    compliance = SurfaceCompliance(BODY, (count, count), pitch_m)
    return FrictionalContact(compliance, paraboloid((count, count), pitch_m, CURVATURE_RADIUS_M), FRICTION)


def partial_slip(folder: Path) -> None:
    """Fig. 13: stick radius against tangential load, of a contact with unknown stick zone and of eq. (7)."""
    load = LOAD_NEWTON
    object_ = contact(64, 10e-3 / 64)
    ratios, found = np.array([0.1, 0.3, 0.5, 0.7, 0.875, 0.95]), []
    for ratio in ratios:
        pressed = object_.step(object_.apart, load_newton=(0.0, 0.0, load))
        state = object_.step(pressed, load_newton=(ratio * FRICTION * load, 0.0, load))
        found.append(np.sqrt(state.sticks.sum() / (state.sticks | state.slips).sum()))
    expected = np.cbrt(1.0 - ratios)
    print(f"Fig. 13: stick radius solved and by eq. (7) differ by {np.abs(found - expected).max():.3f} at most")

    figure = Figure(figsize=(4.5, 3.5), layout="constrained")
    axes = figure.subplots()
    stick = np.linspace(0.0, 1.0, 200)
    axes.plot(1.0 - stick**3, stick, label="eq. (7)")
    axes.plot(np.linspace(0, 1, 200), 1.0 - np.linspace(0, 1, 200) ** 3, "--", label="caption as printed")
    axes.plot(ratios, found, "o", label="solved, stick zone unknown")
    axes.set_xlabel("tangential load / (friction x normal load)")
    axes.set_ylabel("stick radius / contact radius")
    axes.legend(fontsize="small")
    figure.savefig(folder / "fig13-partial-slip.svg")


def encoding(folder: Path) -> None:
    """Fig. 8: signals of a partial slip contact at 32 x 32 sensors, without and with noise."""
    load = LOAD_NEWTON
    shear = (1.0 - STICK_RATIO**3) * FRICTION * load
    object_ = contact(FINER * COUNT, PITCH_M / FINER)
    pressed = object_.step(object_.apart, load_newton=(0.0, 0.0, load))
    traction = object_.step(pressed, load_newton=(shear, 0.0, load)).traction_pascal
    fields = SurfaceFields(BODY, (FINER * COUNT, FINER * COUNT), PITCH_M / FINER, "sensor", DEPTH_M)
    at_sensors = slice(FINER // 2, None, FINER)
    signals = fields(traction)[:, at_sensors, at_sensors]
    along_load = fields(traction * np.array([1.0, 0.0, 1.0])[:, None, None])[:, at_sensors, at_sensors]

    exact = signals_in_closed_form(STICK_RATIO)
    for name, whole, part, other in zip(("p_n", "eps_xz", "eps_yz"), signals, along_load, exact, strict=True):
        error, rest = (np.linalg.norm(found - other) / np.linalg.norm(other) for found in (whole, part))
        print(f"Fig. 8: {name} differs from closed forms by {error:.4f}, without f_y by {rest:.4f} (relative L2)")

    noisy = signals + noise_rms(NOISE_DB) * noise(np.random.default_rng(1))
    figure = Figure(figsize=(10, 6), layout="constrained")
    all_axes = figure.subplots(2, 3, sharex=True, sharey=True)
    for row, (images, what) in enumerate([(signals, ""), (noisy, f", {NOISE_DB:g} dB")]):
        for column, (image, name) in enumerate(zip(images, ("3 p_n / (2 E)", "eps_xz", "eps_yz"), strict=True)):
            axes = all_axes[row, column]
            limit = np.abs(signals[column]).max()
            shown = axes.imshow(image, cmap="RdBu_r", vmin=-limit, vmax=limit, origin="upper", extent=EXTENT_MM)
            axes.set_title(f"{'abcdef'[3 * row + column]}) {name}{what}", fontsize="small")
            figure.colorbar(shown, ax=axes, shrink=0.8)
    figure.supxlabel("x, mm", fontsize="small")
    figure.supylabel("y, mm", fontsize="small")
    figure.savefig(folder / "fig8-encoding.svg")


def main() -> None:
    matplotlib.rcParams["svg.hashsalt"] = "resonatord"  # the same drawing is the same file
    os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
    parser = argparse.ArgumentParser(description="Draw the figures of docs/research/reproduction.md.")
    parser.add_argument(
        "--folder", type=Path, default=Path(__file__).parent, help="where to (default: the folder of this file)"
    )
    folder = parser.parse_args().folder
    power_spectra(folder)
    partial_slip(folder)
    encoding(folder)
    decoders = Decoders(noise_rms(NOISE_DB))
    figures_9_to_12(folder, decoders)
    errors_by_noise(folder, decoders)
    stick_radius(folder, decoders)
    print(f"figures: written to {folder}")


if __name__ == "__main__":
    main()
