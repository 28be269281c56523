"""Conditions of a result that may be accepted: loads of a site that fit together, and K known well enough."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtri

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.tools.calibration.outcome import BAD_NEWTON, Outcome
from resonator_daemon.tools.calibration.steps import SENSITIVITY_STD_MAX, CalibrationRefusedError, Step

SCATTERS: Final = 5.0  # that a site's residual may be: far beyond chance, even of three loads with one to spare
FEWEST_OTHERS: Final = 3  # sites, of which the middle one shows how touches scatter


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
    masses = float(np.max(fit.sensitivity_mass_std[worst] / np.abs(fit.sensitivity[worst])))
    remedies = {
        "load it again with masses further apart, or more often (--repeats)": math.sqrt(
            max(outcome.loads_std[worst] ** 2 - masses**2, 0.0)
        ),
        "hold loads longer (--hold-s)": outcome.creep_std,
        "take masses that are known better (--mass-std)": masses,
    }
    raise CalibrationRefusedError(
        f"site {outcome.plate.site_ids[fit.site[worst]]}: K is known to {100 * outcome.sensitivity_std[worst]:.2g} %, "
        f"must be {100 * SENSITIVITY_STD_MAX:g} % or better; {max(remedies, key=lambda name: remedies[name])}"
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
