"""What is known of a contact before a fit: where the fit begins, and between which bounds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel

_SMALLEST_RADIUS = 0.05  # depths, which signals hardly distinguish from none
_FORCE_LIMIT = 10.0  # times the largest that fits at the start
_LEAST_FORCE = 1e-3  # of the largest that fits at the start


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
    lower = [lowest_x - beyond_m, lowest_y - beyond_m, _SMALLEST_RADIUS * model.shallowest_m]
    upper = [highest_x + beyond_m, highest_y + beyond_m, model.radius_max_m]
    return [*lower, -limit, -limit, _LEAST_FORCE * largest], [*upper, limit, limit, limit]


def disc_starts(
    model: DiscModel, starts: Sequence[ContactStart], signals: Floats, noise_std: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return parameters x, y, a, F_x, F_y, F_z of each contact (contacts, 6), and their lower and upper bounds (6,).

    Forces are those of discs that fit the signals (3 n,) best. ValueError for a start that is not finite or a noise not
    above 0.
    """
    if not (noise_std > 0.0).all():
        raise ValueError(f"noise_std reaches {noise_std.min()}, must be above 0")
    poses = [clipped(model, start) for start in starts]
    columns = np.concatenate([model.signals(pose[:2], float(pose[2])).value for pose in poses])
    columns = columns.reshape(3 * len(poses), -1)
    known = np.isfinite(signals)
    whiten = 1.0 / noise_std[known]
    solution, *_ = np.linalg.lstsq((columns[:, known] * whiten).T, signals[known] * whiten)
    forces = np.asarray(solution, np.float64).reshape(-1, 3)
    lower, upper = (np.array(bound) for bound in bounds(model, float(np.abs(forces).max())))
    return np.column_stack([poses, np.clip(forces, lower[3:], upper[3:])]), lower, upper
