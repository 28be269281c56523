"""Fit of what was captured: the loads and sites that it doubts, and the creep that it does not contain."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.forces.calibration_fit import CalibrationFit, fit_calibration
from resonator_daemon.estimate.forces.loading_fit import RESPONSE_DEFAULT
from resonator_daemon.estimate.forces.loadings import Readings, Steps
from resonator_daemon.tools.calibration.load_procedure import Loading, LoadProcedure
from resonator_daemon.tools.calibration.load_readings import site_codes
from resonator_daemon.tools.calibration.steps import (
    SENSITIVITY_STD_MAX,
    STANDARD_GRAVITY,
    CalibrationRefusedError,
    LoadRequest,
    Step,
)

BAD_SHARE: Final = 0.005  # of the load: what a bad loading is off by, at least
BAD_NEWTON: Final = 2e-3
COMMON_MODE_STD: Final = 1e-9  # of the pilot's mean over some tenths of a second
_SMALLEST_MASS_STD: Final = 1e-9  # stands for exact masses
SCATTERS: Final = 5.0  # that a site's residual may be: far beyond chance, even of three loads with one to spare
FEWEST_OTHERS: Final = 3  # sites, of which the middle one shows how touches scatter
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
    def sensitivity_std(self) -> Floats:
        """By how much each site's K (s,) is unknown in all, relative."""
        loads_std: Floats = np.sqrt(np.mean((self.fit.sensitivity_std / self.fit.sensitivity) ** 2, axis=1))
        return np.hypot(loads_std, self.creep_std)


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


@dataclass(frozen=True)
class OutlierSite:
    """A site whose loads leave more than scatter explains."""

    site_id: int
    steps: tuple[Step, ...]
    residual_newton: float  # rms
    limit_newton: float
    range_newton: float  # of the plate: a residual beyond it is not given as a number: nothing fits

    @property
    def sentence(self) -> str:
        off = f"{1e3 * self.residual_newton:.0f} mN rms"
        if self.residual_newton > self.range_newton:
            off = f"above {self.range_newton:g} N"
        limit = f"at most {1e3 * self.limit_newton:.0f} mN, {SCATTERS:g} times what scatter explains"
        return f"site {self.site_id}: its loads do not fit together: residual {off}, {limit}"


@dataclass(frozen=True)
class _SiteLoads:
    steps: tuple[Step, ...]
    force_newton: float  # rms
    residual_newton: float  # rms
    share: float  # scatter of a load by these residuals, relative
    freedom: int


def find_outliers(outcome: Outcome) -> tuple[OutlierSite, ...]:
    """Return the sites whose loads, but for doubtful ones, lie too far off their line.

    A load scatters by the plate file's model_error in each channel alone, or by what the other sites show, if that is
    more; and by the error of the masses.
    """
    plate, mass_std = outcome.plate, outcome.request.mass_std
    sites = _by_site([step for step in outcome.steps if step not in outcome.doubtful], outcome)
    found = []
    for site_id, site in sites.items():
        others = [other for other_id, other in sites.items() if other_id != site_id]
        share = math.hypot(max(plate.calibration.model_error / math.sqrt(CHANNEL_COUNT), _usual(others)), mass_std)
        seen = math.sqrt(site.freedom / len(site.steps))  # of the scatter: the line takes the rest for itself
        limit_newton = SCATTERS * math.hypot(share * site.force_newton, BAD_NEWTON) * seen
        if not site.residual_newton <= limit_newton:
            found.append(OutlierSite(site_id, site.steps, site.residual_newton, limit_newton, plate.force_max_newton))
    return tuple(found)


def refuse_unknown_sensitivity(outcome: Outcome) -> None:
    """Raise CalibrationRefusedError where K of a site is known worse than any calibration may be."""
    fit = outcome.fit
    worst = int(np.argmax(outcome.sensitivity_std))
    if outcome.sensitivity_std[worst] <= SENSITIVITY_STD_MAX:
        return
    raise CalibrationRefusedError(
        f"site {outcome.plate.site_ids[fit.site[worst]]}: K is known to {100 * outcome.sensitivity_std[worst]:.2g} %, "
        f"must be {100 * SENSITIVITY_STD_MAX:g} % or better; hold loads longer (--hold-s), load each site more often "
        "(--repeats), with masses further apart, or take masses that are known better (--mass-std)"
    )


def _by_site(steps: Sequence[Step], outcome: Outcome) -> dict[int, _SiteLoads]:
    """Sites with more loads than a line needs."""
    sites = {}
    for site_id in dict.fromkeys(step.site_id for step in steps):
        own = tuple(step for step in steps if step.site_id == site_id)
        force = np.array([step.force_newton for step in own])
        residual = np.array([outcome.residual_newton[step.number] for step in own])
        freedom = len(own) - min(2, len(set(force.tolist())))
        if freedom > 0:
            share = math.sqrt(float(np.sum((residual / force) ** 2)) / freedom)
            sites[site_id] = _SiteLoads(own, _rms(force), _rms(residual), share, freedom)
    return sites


def _usual(sites: Sequence[_SiteLoads]) -> float:
    """Scatter of a load, relative, by the middle one of some sites; 0 where they are too few."""
    if len(sites) < FEWEST_OTHERS:
        return 0.0
    return math.sqrt(np.median([site.share**2 * site.freedom / chdtri(site.freedom, 0.5) for site in sites]))


def _rms(values: np.ndarray) -> float:
    return math.sqrt(float(np.mean(values**2)))
