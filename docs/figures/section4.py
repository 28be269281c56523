"""The paper's Figs 9-12, and the errors behind them at other noise: traction and displacement decoded from signals."""

from pathlib import Path

import numpy as np
from decoders import AT_SENSORS, COMPLIANCE, TRANSFER, Decoders, filtered, wiener
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scene import (
    AXIS_M,
    BODY,
    COUNT,
    CURVATURE_RADIUS_M,
    DEPTH_M,
    EDGE_MM,
    EXTENT_MM,
    FRICTION,
    NOISE_DB,
    PITCH_M,
    RADIUS_M,
    SITES_M,
    STICK_RATIO,
    displacements,
    error,
    noise,
    noise_rms,
    noise_spectrum,
    signals,
    tractions,
)

from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart
from resonator_daemon.estimate.surface.fitting.slip_fitter import fit_partial_slip

Floats = NDArray[np.float64]
Fields = dict[str, tuple[Floats, Floats]]  # traction and displacement by the name of the decoder

TRUTH, PLAIN, WIENER, OPEN_PLANE, CONTACT = "truth", "unregularised", "Wiener, eq. (5)", "open plane", "contact physics"
COLOURS = {TRUTH: "black", PLAIN: "grey", WIENER: "tab:red", OPEN_PLANE: "tab:blue", CONTACT: "tab:green"}
LEVELS_DB = (11, 20, 30, 40)
DRAWS = 2
PANELS = (("f_x, kPa", 0, 0, 1e-3), ("f_z, kPa", 0, 2, 1e-3), ("u_x, mm", 1, 0, 1e3), ("u_z, mm", 1, 2, 1e3))
ROW = COUNT // 2  # of the profiles


def figures_9_to_12(folder: Path, decoders: Decoders) -> None:
    """Decode one frame of 11 dB; draw profiles, displacements and tractions."""
    noise_std, truth = noise_rms(NOISE_DB), tractions(STICK_RATIO)
    noisy = signals(STICK_RATIO) + noise_std * noise(np.random.default_rng(1))
    known_noise = noise_std**2 * noise_spectrum()[:, : COUNT // 2 + 1] / np.mean(truth**2)
    fields = {TRUTH: (truth, displacements(STICK_RATIO))}
    for name, inverse in ((PLAIN, np.linalg.inv(TRANSFER)), (WIENER, wiener(known_noise))):
        fields[name] = filtered(inverse, noisy), filtered(COMPLIANCE @ inverse, noisy)
    decoded = decoders.open_plane.decode(noisy, displacement=True)
    fields[OPEN_PLANE] = decoded.traction_pascal, np.asarray(decoded.displacement_m)
    constrained = decoders.contact(noisy, FRICTION)
    fields[CONTACT] = constrained, AT_SENSORS(constrained)
    print("Figs 9-12, relative L2 error: decoder, f_x, f_z, f, u_x, u_z, u")
    for name, found in list(fields.items())[1:]:
        cells = []
        for got, true in zip(found, fields[TRUTH], strict=True):
            cells += [error(got[0], true[0]), error(got[2], true[2]), error(got, true)]
        print(f"| {name} |", *(f"{cell:.0f} |" if cell > 10.0 else f"{cell:.3f} |" for cell in cells))
    shape(fields, noisy, noise_std)
    profiles(folder, fields, decoded.traction_std_pascal)
    maps(folder / "fig11-displacements.svg", fields, PANELS[2:])
    maps(folder / "fig12-tractions.svg", fields, PANELS[:2])


def shape(fields: Fields, noisy: Floats, noise_std: float) -> None:
    """Radius of curvature, of u_z = d - r^2 / (2 R) inside the contact and by a fit to the signals; net force."""
    x, y = SITES_M.T
    inside = np.hypot(x, y) < RADIUS_M
    columns = np.column_stack([np.ones_like(x), x, y, x**2 + y**2])[inside]
    print(f"Radius of curvature, mm, true {CURVATURE_RADIUS_M * 1e3:.1f}; net force over the true one, x, z")
    true_newton = PITCH_M**2 * fields[TRUTH][0].sum(axis=(1, 2))[[0, 2]]
    for name in (WIENER, OPEN_PLANE, CONTACT):
        traction, displacement = fields[name]
        *_, bend = np.linalg.lstsq(columns, displacement[2].ravel()[inside], rcond=None)[0]
        share = PITCH_M**2 * traction.sum(axis=(1, 2))[[0, 2]] / true_newton
        print(f"| {name} | {-500.0 / bend:.1f} | {share[0]:.3f} | {share[1]:.3f} |")
    model, start = DiscModel(BODY, SITES_M, DEPTH_M, 2.0 * RADIUS_M), ContactStart((0.0, 0.0), RADIUS_M)
    (found,) = fit_partial_slip(model, noisy.reshape(3, -1), noise_std, [start])
    stiffness_pascal = 4.0 / 3.0 * BODY.youngs_modulus_pascal / (1.0 - BODY.poisson_ratio**2)
    bend_m = stiffness_pascal * found.radius_m**3 / found.force_newton[2]  # by Hertz
    share = found.force_newton[[0, 2]] / true_newton
    print(f"| contact model, fitted | {bend_m * 1e3:.1f} | {share[0]:.3f} | {share[1]:.3f} |")


def profiles(folder: Path, fields: Fields, std_pascal: Floats) -> None:
    """Figs 9 and 10: along the row of sensors next to the middle."""
    figure = Figure(figsize=(12, 5.8), layout="constrained")
    x_mm = AXIS_M * 1e3
    for row, (names, title) in enumerate(
        (((PLAIN, TRUTH), "Fig. 9"), ((WIENER, OPEN_PLANE, CONTACT, TRUTH), "Fig. 10"))
    ):
        for column, (label, kind, component, factor) in enumerate(PANELS):
            axes = figure.add_subplot(2, 4, 4 * row + column + 1)
            for name in names:
                line = fields[name][kind][component, ROW] * factor
                axes.plot(x_mm, line, color=COLOURS[name], linewidth=1.0 if name == PLAIN else 1.4, label=name)
                if name == OPEN_PLANE and kind == 0:
                    spread = 2.0 * std_pascal[component, ROW] * factor
                    low, high = line - spread, line + spread
                    axes.fill_between(x_mm, low, high, color=COLOURS[name], alpha=0.15, label="open plane, 2 sd")
            axes.set_title(f"{title}: {label}", fontsize="small")
            axes.set_xlim(-EDGE_MM, EDGE_MM)
    above, below = (figure.axes[index].get_legend_handles_labels() for index in (0, 4))
    figure.legend(
        above[0][:1] + below[0], above[1][:1] + below[1], loc="outside upper center", ncols=6, fontsize="small"
    )
    figure.supxlabel(f"x, mm, at y = {AXIS_M[ROW] * 1e3:.1f} mm", fontsize="small")
    figure.savefig(folder / "fig9-10-profiles.svg")


def maps(path: Path, fields: Fields, panels: tuple[tuple[str, int, int, float], ...]) -> None:
    """Figs 11 and 12: each row on the colour scale of its truth."""
    figure = Figure(figsize=(12, 5.1), layout="constrained")
    all_axes = figure.subplots(len(panels), len(fields), sharex=True, sharey=True)
    for (label, kind, component, factor), row in zip(panels, all_axes, strict=True):
        limit = np.abs(fields[TRUTH][kind][component]).max() * factor
        for (name, found), axes in zip(fields.items(), row, strict=True):
            image = found[kind][component] * factor
            shown = axes.imshow(image, cmap="RdBu_r", vmin=-limit, vmax=limit, origin="upper", extent=EXTENT_MM)
            axes.set_title(f"{label.split(',')[0]}, {name}", fontsize="small")
        figure.colorbar(shown, ax=list(row), label=label, extend="both", pad=0.01)
    figure.supxlabel("x, mm", fontsize="small")
    figure.supylabel("y, mm", fontsize="small")
    figure.savefig(path)


def errors_by_noise(folder: Path, decoders: Decoders) -> None:
    """Errors of the traction under white noise; the signals are scaled, the noise is the same."""
    std, clean, truth = decoders.noise_std, signals(STICK_RATIO), tractions(STICK_RATIO)
    found: dict[str, list[float]] = {
        PLAIN: [],
        WIENER: [],
        OPEN_PLANE: [],
        "contact physics, mu unknown": [],
        CONTACT: [],
    }
    for level in LEVELS_DB:
        scale = std / noise_rms(level)
        off = []
        for draw in range(DRAWS):
            noisy = scale * clean + std * np.random.default_rng(draw).standard_normal(clean.shape)
            true = scale * truth
            decoded = (
                filtered(np.linalg.inv(TRANSFER), noisy),
                filtered(wiener(std**2 / np.mean(true**2)), noisy),
                decoders.open_plane.decode(noisy).traction_pascal,
                decoders.contact(noisy, None),
                decoders.contact(noisy, FRICTION),
            )
            off.append([error(one, true) for one in decoded])
        for name, value in zip(found, np.mean(off, axis=0), strict=True):
            found[name].append(value)
    print(f"White noise, relative L2 error of the traction at {LEVELS_DB} dB")
    for name, values in found.items():
        print(f"| {name} |", *(f"{value:.0f} |" if value > 10.0 else f"{value:.3f} |" for value in values))

    figure = Figure(figsize=(5.5, 4), layout="constrained")
    axes = figure.subplots()
    for name, values in found.items():
        if name != PLAIN:  # far above
            axes.plot(LEVELS_DB, values, "o-", color=COLOURS.get(name, "tab:olive"), label=name)
    axes.set_xlabel("signal to white noise, dB")
    axes.set_ylabel("relative error of the traction")
    axes.set_ylim(0.0, None)
    axes.legend(fontsize="small")
    figure.savefig(folder / "error-by-noise.svg")
