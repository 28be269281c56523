"""Share of a load that the other sites feel, from a plate that counts all of them at once."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.optimize import minimize_scalar

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import Coupling
from resonator_daemon.tools.calibration.load_procedure import Loading, LoadProcedure

SIGMAS: Final = 3.0
OSCILLATOR_STD: Final = 1e-9  # of the mean of a hold against the untouched plate some seconds before
WIDTH_TOLERANCE: Final = 0.05  # relative, to which a width in the plate file should agree


def find_coupling(
    plate: Plate, procedure: LoadProcedure, loadings: Sequence[Loading], sensitivity: Floats
) -> tuple[Coupling, ...]:
    """Return what lies above 3 standard deviations, of loads on any of the sites; sensitivity (sites, 4)."""
    found = []
    square = (sensitivity**2).sum(axis=1)
    for pressed in sorted({loading.site for loading in loadings}):
        loads = [loading for loading in loadings if loading.site == pressed]
        force = np.array([loading.step.force_newton for loading in loads])
        newton = np.array(
            [(_moved(procedure, load) * sensitivity).sum(axis=1) / square for load in loads]
        )  # (k, sites)
        ratio = force @ newton / (force @ force)
        std = OSCILLATOR_STD / np.sqrt(square / sensitivity.shape[1]) / np.sqrt(force @ force)
        found += [
            Coupling(
                pressed=int(plate.site_ids[pressed]),
                measured=int(plate.site_ids[measured]),
                ratio=float(ratio[measured]),
            )
            for measured in np.flatnonzero(np.abs(ratio) > SIGMAS * std)
            if measured != pressed
        ]
    return tuple(found)


def width_m(plate: Plate, coupling: Sequence[Coupling]) -> float:
    """Width w of the cover that explains coupling best, as a spread of (1 + r^2/w^2)^(-3/2)."""
    distance_m, ratio = _distances(plate, coupling), np.array([pair.ratio for pair in coupling])

    def squared_error(log_width: float) -> float:
        return float(np.sum((ratio - _spread(distance_m, np.exp(log_width))) ** 2))

    low, high = np.log(distance_m.min() / 30.0), np.log(distance_m.max())
    return float(np.exp(minimize_scalar(squared_error, bounds=(low, high), method="bounded").x))


def compare_with_width(plate: Plate, coupling: Sequence[Coupling]) -> str:
    """Return a sentence that sets coupling against the plate file's spread_width_mm; "" where it has none."""
    if plate.spread_width_m is None or not coupling:
        return ""
    ratio = np.array([pair.ratio for pair in coupling])
    off = np.abs(ratio - _spread(_distances(plate, coupling), plate.spread_width_m))
    found_mm = 1e3 * width_m(plate, coupling)
    agrees = abs(found_mm / (1e3 * plate.spread_width_m) - 1) <= WIDTH_TOLERANCE
    worst = coupling[int(off.argmax())]
    return (
        f"coupling fits a spread of {found_mm:.3g} mm, spread_width_mm = {1e3 * plate.spread_width_m:g} "
        f"{'agrees' if agrees else 'differs'}; the largest departure from the file's is {off.max():.2g} of the force, "
        f"of site {worst.measured} with site {worst.pressed} pressed"
    )


def _moved(procedure: LoadProcedure, loading: Loading) -> Floats:
    """Shift (sites, 4) since the untouched reading before the load, the common mode taken out of both."""
    if loading.site_shift is None:
        raise ValueError("a loading of a plate that counts one site at a time")
    before = procedure.untouched.before(loading.since_s)
    rest = 1 - (1 - procedure.untouched.site_shift[before]) * (1 + procedure.untouched.common_mode[before])
    common = procedure.untouched.at(float(loading.times_s.mean()))
    moved: Floats = 1 - (1 - loading.site_shift) * (1 + common) - rest
    return moved


def _distances(plate: Plate, coupling: Sequence[Coupling]) -> Floats:
    index = {int(site_id): row for row, site_id in enumerate(plate.site_ids)}
    pairs = np.array([(index[pair.pressed], index[pair.measured]) for pair in coupling])
    distance: Floats = np.linalg.norm(np.diff(plate.site_positions_m[pairs], axis=1)[:, 0], axis=1)
    return distance


def _spread(distance_m: Floats, width_m: float) -> Floats:
    share: Floats = (1 + (distance_m / width_m) ** 2) ** -1.5
    return share
