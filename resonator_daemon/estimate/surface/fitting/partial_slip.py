"""Contact that sticks in its middle and slips at its rim, fitted to the signals of one frame.

A paraboloid that presses with F_n and is sheared with F_t < mu F_n sticks within c of the centre of a contact of radius
a (Cattaneo 1938, Mindlin 1949; Johnson, Contact Mechanics, 1985, section 7.2). With h_a the Hertz distribution of unit
force on radius a, and the margin to slip m = 1 - F_t / (mu F_n) = (c / a)^3,

    f_z = F_n h_a,    f_t = F_t [ h_a + m / (1 - m) (h_a - h_c) ],

so that a frame determines m by itself; where mu is known, the forces determine it, too, and better.
"""

import math
from dataclasses import dataclass

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.fitting.contact_fit import Fit
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.slip_signals import FORCE_X, FORCE_Z, MARGIN, RADIUS

_SMALLEST_RADIUS = 0.05  # depths, which signals hardly distinguish from none
_FORCE_LIMIT = 10.0  # times the largest that fits at the start
_LEAST_FORCE = 1e-3  # of the largest that fits at the start

MARGIN_STD_LIMIT = 0.2  # a margin of a larger one is reported as unknown
_FORCE_SIGNIFICANCE = 5.0  # standard deviations of a normal force
_TOO_LITTLE = Reason(ReasonCode.SLIPS_TOO_LITTLE, "the contact slips too little to show in the signals")


@dataclass(frozen=True)
class Friction:
    """A friction coefficient that is known before the frame.

    Forces and stick radius are weighed by its standard deviation. A wrong modulus shifts the ratio of forces as a wrong
    mu does, so that `std` should be no less than the modulus' relative error, times mu.
    """

    coefficient: float
    std: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.coefficient < np.inf:
            raise ValueError(f"friction coefficient is {self.coefficient}, must be finite and above 0")
        if not 0.0 <= self.std < np.inf:
            raise ValueError(f"standard deviation of the friction is {self.std}, must be finite and at least 0")


@dataclass(frozen=True)
class ContactStart:
    """What is known of a contact before the frame: from a patch of the decoded map, or from the frame before."""

    centre_m: tuple[float, float]  # within about a radius
    radius_m: float
    slip_margin: float = np.nan  # where neither it nor mu is known, several are tried
    friction: Friction | None = None


def clipped(model: DiscModel, start: ContactStart) -> Floats:
    """Centre and radius (3,) of a start, where a fit may begin; ValueError for one that is not finite."""
    pose = np.array([*start.centre_m, start.radius_m])
    if not np.isfinite(pose).all():
        raise ValueError(f"start {start.centre_m} m, radius {start.radius_m} m must be finite")
    lower, upper = bounds(model, 1.0)
    return np.asarray(np.clip(pose, lower[:3], upper[:3]), np.float64)


def bounds(model: DiscModel, force_newton: float) -> tuple[list[float], list[float]]:
    """Lower and upper bounds of x, y, a, F_x, F_y, F_z, of contacts whose largest force is about as given.

    Centres may lie as far beyond the sites as half the model's margin, so that what is spread about them stays within
    it.
    """
    beyond_m = model.margin_m / 2.0
    (lowest_x, lowest_y), (highest_x, highest_y) = model.lowest_m.tolist(), model.highest_m.tolist()
    largest = max(float(force_newton), 1e-300)
    limit = _FORCE_LIMIT * largest
    lower = [lowest_x - beyond_m, lowest_y - beyond_m, _SMALLEST_RADIUS * model.depth_m]
    upper = [highest_x + beyond_m, highest_y + beyond_m, model.radius_max_m]
    return [*lower, -limit, -limit, _LEAST_FORCE * largest], [*upper, limit, limit, limit]


@dataclass(frozen=True)
class PartialSlip:
    """One contact in one frame. What is not known is NaN, with the cause in `reason`, None where all is known."""

    centre_m: Floats  # (2,)
    centre_std_m: Floats
    radius_m: float
    radius_std_m: float
    force_newton: Floats  # (3,)
    force_std_newton: Floats
    slip_margin: float
    slip_margin_std: float
    stick_ratio: float  # c / a
    stick_ratio_std: float
    friction_coefficient: float  # from forces and stick radius of this frame, and what was known before
    friction_coefficient_std: float
    covariance: Floats  # (7, 7) of x, y, a, F_x, F_y, F_z, m
    systematic: Floats  # (7, 7), likewise: of what does not average out
    friction_coefficient_systematic: float
    chi2: float
    degrees_of_freedom: int
    status: str  # "ok"; "unknown" where the margin is
    reason: Reason | None


def describe(
    found: Fit, one: Floats, covariance: Floats, systematic: Floats, radius_max_m: float, *, margin_known: bool
) -> PartialSlip:
    """Describe one of the contacts that were fitted together.

    Parameters
    ----------
    found
        The fit of all of them.
    one
        Parameters of this one, x, y, a, F_x, F_y, F_z, m.
    covariance, systematic
        Of those, (7, 7): for the noise, and for the uncertainty of the skin.
    radius_max_m
        Of a contact that can be distinguished from one without a rim.
    margin_known
        False where other margins explain the signals about as well.
    """
    doubt = _doubt(found, one, covariance, radius_max_m)
    if doubt is not None:
        return nothing_known(found.chi2, doubt, found.degrees_of_freedom)
    std = np.sqrt(covariance.diagonal())
    margin, margin_std = float(one[MARGIN]), float(std[MARGIN])
    if not margin_known or margin_std > MARGIN_STD_LIMIT:
        slip, status, reason = (math.nan,) * 6, "unknown", _TOO_LITTLE
        friction_systematic = math.nan
    else:
        slip = (margin, margin_std, *stick_ratio(margin, margin_std), *_friction(one, covariance))
        status, reason = "ok", None
        _, friction_systematic = _friction(one, systematic)
    pose = one[:RADIUS], std[:RADIUS], float(one[RADIUS]), float(std[RADIUS])
    force, covariances = (one[FORCE_X:MARGIN], std[FORCE_X:MARGIN]), (covariance, systematic)
    return PartialSlip(
        *pose, *force, *slip, *covariances, friction_systematic, found.chi2, found.degrees_of_freedom, status, reason
    )


def nothing_known(chi2: float, reason: Reason, degrees_of_freedom: int = 0) -> PartialSlip:
    """Describe a contact of which the frame shows nothing."""
    two, three = np.full(2, np.nan), np.full(3, np.nan)
    nothing = (np.nan,) * 6
    covariance = np.full((7, 7), np.nan)
    return PartialSlip(
        *(two, two, np.nan, np.nan, three, three, *nothing, covariance, covariance, np.nan),
        *(chi2, degrees_of_freedom, "unknown", reason),
    )


def _doubt(found: Fit, one: Floats, covariance: Floats, radius_max_m: float) -> Reason | None:
    """Return why nothing is known of a contact; None where something is."""
    if not np.isfinite(covariance).all():
        return Reason(ReasonCode.FIT_UNDETERMINED, "the signals do not determine the contact")
    if found.doubt:
        return Reason(ReasonCode.FIT_REJECTED, found.doubt)
    if one[FORCE_Z] < _FORCE_SIGNIFICANCE * math.sqrt(covariance[FORCE_Z, FORCE_Z]):
        return Reason(
            ReasonCode.FORCE_INSIGNIFICANT, f"the normal force is below {_FORCE_SIGNIFICANCE:g} standard deviations"
        )
    if one[RADIUS] >= radius_max_m:
        return Reason(ReasonCode.CONTACT_TOO_LARGE, f"the contact is larger than {radius_max_m} m in radius")
    return None


def stick_ratio(slip_margin: float, slip_margin_std: float) -> tuple[float, float]:
    """Return c / a = m^(1/3) and its standard deviation: by the ends of the margin's: the root is steep at 0."""
    middle, lower, upper = (
        min(max(margin, 0.0), 1.0) ** (1.0 / 3.0)
        for margin in (slip_margin, slip_margin - slip_margin_std, slip_margin + slip_margin_std)
    )
    return middle, (upper - lower) / 2.0


def _friction(one: Floats, covariance: Floats) -> tuple[float, float]:
    """Mu = F_t / (F_n (1 - m)), and its standard deviation to first order; NaN without shear."""
    force_x, force_y, force_z, margin = one[FORCE_X:].tolist()
    square = force_x**2 + force_y**2
    if square == 0.0:
        return math.nan, math.nan
    mu = math.sqrt(square) / (force_z * (1.0 - margin))
    relative = np.array([force_x / square, force_y / square, -1.0 / force_z, 1.0 / (1.0 - margin)])
    return mu, mu * math.sqrt(max(relative @ covariance[FORCE_X:, FORCE_X:] @ relative, 0.0))  # 0 but for rounding
