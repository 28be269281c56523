"""Fit of what was captured, with the loads that it doubts, and the creep that it does not contain."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.forces.calibration_fit import CalibrationFit, fit_calibration
from resonator_daemon.estimate.forces.loading_fit import RESPONSE_DEFAULT
from resonator_daemon.estimate.forces.loadings import Readings, Steps
from resonator_daemon.tools.calibration.load_procedure import Loading, LoadProcedure
from resonator_daemon.tools.calibration.load_readings import site_codes
from resonator_daemon.tools.calibration.steps import STANDARD_GRAVITY, LoadRequest, Step

BAD_SHARE: Final = 0.005  # of the load: what a bad loading is off by, at least
BAD_NEWTON: Final = 2e-3
COMMON_MODE_STD: Final = 1e-9  # of the pilot's mean over some tenths of a second
_SMALLEST_MASS_STD: Final = 1e-9  # stands for exact masses
_PACE_SIGMAS: Final = 2.0  # of the pace, so that holds too short to show creep do not rule it out
_CARRIED_ON_S: Final = math.exp(RESPONSE_DEFAULT[2])  # creep that begins at some pace and dies out goes on for its time


@dataclass(frozen=True)
class Outcome:
    """A fit of all loads, with the steps that it doubts.

    Attributes
    ----------
    untouched_hz
        (sites, 4): frequencies by which shifts go, where the untouched plate was measured; otherwise None.
    residual_newton
        By number of the step.
    creep_share
        Of a force, by which sites would creep further; NaN where no load came from zero.
    """

    procedure: LoadProcedure
    request: LoadRequest
    untouched_hz: Floats | None
    fit: CalibrationFit
    steps: tuple[Step, ...]
    doubtful: tuple[Step, ...]
    swapped: tuple[Step, Step] | None
    residual_newton: dict[int, float]
    creep_share: float

    @property
    def plate(self) -> Plate:
        return self.procedure.plate

    @property
    def creep_std(self) -> float:
        """What creep that was not fitted may add, relative."""
        return 0.0 if self.fit.response is not None else self.creep_share

    @property
    def loads_std(self) -> Floats:
        """By how much each site's K (s,) is unknown for its loads and masses, relative."""
        std: Floats = np.sqrt(np.mean((self.fit.sensitivity_std / self.fit.sensitivity) ** 2, axis=1))
        return std

    @property
    def sensitivity_std(self) -> Floats:
        """By how much each site's K (s,) is unknown in all, relative."""
        return np.hypot(self.loads_std, self.creep_std)


class _Change(NamedTuple):
    """A load that comes to a site, or goes: then `loading` is None."""

    site: int
    since_s: float
    kelvin: float
    loading: Loading | None


def fit_loadings(
    procedure: LoadProcedure,
    request: LoadRequest,
    loadings: Sequence[Loading],
    *,
    with_response: bool,
    untouched_hz: Floats | None = None,
) -> Outcome:
    """Fit loads of any of the sites, those of a temperature sweep aside."""
    used = [loading for loading in loadings if not loading.step.at_temperature]
    codes = site_codes(procedure.plate)
    masses_kg = np.array(request.masses_kg)
    changes = _changes(procedure, used)
    lying_kg = [change.loading.step.mass_kg if change.loading else math.nan for change in changes]
    captured = [(row, change.loading) for row, change in enumerate(changes) if change.loading is not None]
    fit = fit_calibration(
        codes.f0_hz if untouched_hz is None else untouched_hz,
        codes.sensitivity,
        masses_kg * STANDARD_GRAVITY,
        np.full(len(masses_kg), max(request.mass_std, _SMALLEST_MASS_STD)),
        Steps(
            np.array([change.site for change in changes]),
            np.array([change.since_s for change in changes]),
            masses_kg == np.array(lying_kg)[:, None],
            np.full(len(changes), COMMON_MODE_STD),
            np.array([math.nan if request.kelvin is None else change.kelvin for change in changes]),
        ),
        Readings(
            np.concatenate([np.full(len(load.times_s), row) for row, load in captured]),
            np.concatenate([load.times_s for _, load in captured]),
            np.concatenate([load.without_common_mode(procedure.untouched) for _, load in captured]),
            np.concatenate([load.std for _, load in captured]),
            np.concatenate([np.full(len(load.times_s), load.oscillator_std) for _, load in captured]),
        ),
        with_response=with_response,
    )
    step = {row: load.step for row, load in captured}
    residual_newton = {step[row].number: float(fit.residual_newton[row]) for row in step}
    return Outcome(
        procedure,
        request,
        untouched_hz,
        fit,
        tuple(loading.step for loading in used),
        # What is doubtful by so little is left out of the fit, and not worth another load.
        tuple(
            bad
            for bad in (step[row] for row in fit.doubtful_steps)
            if abs(residual_newton[bad.number]) > BAD_NEWTON + BAD_SHARE * bad.force_newton
        ),
        None if fit.swapped_steps is None else (step[fit.swapped_steps[0]], step[fit.swapped_steps[1]]),
        residual_newton,
        _creep_share(procedure, [load for load in used if not load.step.continues], fit),
    )


def _changes(procedure: LoadProcedure, loadings: Sequence[Loading]) -> list[_Change]:
    """Return the changes that loadings were, in their order."""
    changes = []
    for loading in sorted(loadings, key=lambda loading: loading.since_s):
        changes.append(_Change(loading.site, loading.since_s, loading.step.kelvin, loading))
        released_s = min((time_s for time_s in procedure.released_s if time_s > loading.times_s[-1]), default=math.inf)
        following = [other.since_s for other in procedure.loadings.values() if other.since_s > loading.since_s]
        if released_s <= min(following, default=released_s) < math.inf:  # else another mass followed on the same site
            changes.append(_Change(loading.site, released_s, loading.step.kelvin, None))
    return changes


def _creep_share(procedure: LoadProcedure, loadings: Sequence[Loading], fit: CalibrationFit) -> float:
    """Share of a force by which sites may creep on, at the pace of the holds, for as long as creep usually takes.

    The pace is the fastest that readings allow, of loads from zero on sites that `fit` has; NaN where there are none.
    """
    sites = fit.site.tolist()
    growth = [
        _pace(load, procedure, fit.sensitivity[sites.index(load.site)]) for load in loadings if load.site in sites
    ]
    pace, weight = np.array(growth).reshape(-1, 2).T
    if not weight.sum() > 0:
        return math.nan
    return (abs(float(weight @ pace / weight.sum())) + _PACE_SIGMAS / math.sqrt(weight.sum())) * _CARRIED_ON_S


def _pace(loading: Loading, procedure: LoadProcedure, sensitivity: Floats) -> tuple[float, float]:
    """Return how fast the reading grows, 1/s of the force, and the inverse of its variance."""
    lever = loading.times_s - loading.times_s.mean()
    by_channel = sensitivity / (sensitivity @ sensitivity)
    newton = loading.without_common_mode(procedure.untouched) @ by_channel
    common_newton = loading.oscillator_std * by_channel.sum()
    variance = common_newton**2 + (loading.std.mean(axis=0) * by_channel) @ (loading.std.mean(axis=0) * by_channel)
    spread = float(lever @ lever)
    force = loading.step.force_newton
    return float(lever @ newton) / spread / force, spread * force**2 / variance
