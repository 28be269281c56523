"""Stick radius against load, as section 4.2 of the paper wants it known: found in noisy signals and by eq. (7)."""

from pathlib import Path

import numpy as np
from decoders import Decoders
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scene import BODY, DEPTH_M, FRICTION, PITCH_M, RADIUS_M, SITES_M, noise_rms, signals

from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, Friction
from resonator_daemon.estimate.surface.fitting.slip_fitter import fit_partial_slip
from resonator_daemon.estimate.surface.patches import PatchFinder

Floats = NDArray[np.float64]

LOADS = (0.1, 0.3, 0.5, 0.7, 0.8, 0.875, 0.95)  # F_t / (mu F_z)
LEVELS_DB = (11, 20)
DRAWS = 2
KNOWN, UNKNOWN, EDGE = "fit, mu known", "fit, mu unknown", "edge of the decoded map"
STYLES = {KNOWN: ("o", "tab:blue", -0.008), UNKNOWN: ("s", "tab:olive", 0.008), EDGE: ("x", "tab:red", 0.0)}
STICKS = 0.9  # of mu f_z: shear below it counts as held


def stick_radius(folder: Path, decoders: Decoders) -> None:
    """Draw the first of a few frames of each load and level; print the errors of all."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    all_axes = figure.subplots(1, 2, sharey=True)
    curve = np.linspace(0.0, 1.0, 300)
    print("Stick radius over contact radius: level, method, rms error, frames that leave it unknown")
    for level, axes in zip(LEVELS_DB, all_axes, strict=True):
        axes.plot(1.0 - curve**3, curve, color="black", linewidth=1.0, label="eq. (7)")
        ratios, spreads = measured(decoders, level)
        for name, ratio, spread in zip(STYLES, ratios, spreads, strict=True):
            off = ratio - np.cbrt(1.0 - np.array(LOADS))[:, None]
            print(f"| {level} dB | {name} | {np.sqrt(np.nanmean(off**2)):.3f} | {np.isnan(off).sum()} of {off.size} |")
            marker, colour, aside = STYLES[name]
            bars = None if name == EDGE else 2.0 * spread[:, 0]
            places = np.array(LOADS) + aside
            axes.errorbar(places, ratio[:, 0], bars, color=colour, marker=marker, linestyle="none", label=name)
        axes.set_title(f"white noise, {level} dB; bars of 2 sd", fontsize="small")
        axes.set_ylim(0.0, 1.1)
        axes.set_xlabel("tangential load / (friction x normal load)")
    all_axes[0].set_ylabel("stick radius / contact radius")
    all_axes[0].legend(fontsize="small")
    figure.savefig(folder / "stick-radius.svg")


def measured(decoders: Decoders, level: float) -> tuple[Floats, Floats]:
    """C / a and its standard deviation, each (methods, loads, draws), NaN where unknown."""
    model = DiscModel(BODY, SITES_M, DEPTH_M, 2.0 * RADIUS_M)
    finder = PatchFinder(SITES_M, PITCH_M**2, DEPTH_M)
    scale = decoders.noise_std / noise_rms(level)
    ratios, spreads = np.full((2, len(STYLES), len(LOADS), DRAWS), np.nan)
    for row, load in enumerate(LOADS):
        clean = scale * signals(float(np.cbrt(1.0 - load)))
        for draw in range(DRAWS):
            noise = np.random.default_rng([row, draw]).standard_normal(clean.shape)
            noisy = clean + decoders.noise_std * noise
            decoded = decoders.open_plane.decode(noisy)
            patch = finder.find(decoded.traction_pascal, decoded.traction_std_pascal)[0]
            centre_m = (float(patch.centroid_m[0]), float(patch.centroid_m[1]))
            for index, friction in enumerate((Friction(FRICTION), None)):
                start = ContactStart(centre_m, patch.radius_m, friction=friction)
                slip = fit_partial_slip(model, noisy.reshape(3, -1), decoders.noise_std, [start])[0]
                ratios[index, row, draw], spreads[index, row, draw] = slip.stick_ratio, slip.stick_ratio_std
            ratios[2, row, draw] = edge(decoders.contact(noisy, FRICTION))
    return ratios, spreads


def edge(traction_pascal: Floats) -> float:
    """C / a from the areas where the decoded shear is held and where there is a load at all."""
    shear = np.hypot(traction_pascal[0], traction_pascal[1])
    pressed = traction_pascal[2] > 0.05 * traction_pascal[2].max()
    held = pressed & (shear < STICKS * FRICTION * traction_pascal[2])
    return float(np.sqrt(held.sum() / pressed.sum()))
