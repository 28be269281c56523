"""Coulomb's law as a datum of a fit: margin and forces of a contact agree within the uncertainty of its friction."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.fitting.contact_start import Friction
from resonator_daemon.decoding.fitting.slip_signals import FORCE_X, PARAMETERS

_EXACT_STD = 1e-3  # of the margin, to which the law is held where mu is exact
_CHANGED = 0.03  # relative, of a standard deviation
_LINEAR = 0.05  # standard deviations


class Breach(NamedTuple):
    """By how much a contact breaks the law, in standard deviations."""

    value: float
    slopes: Floats  # (4,), by F_x, F_y, F_z, m


class FrictionLaw(NamedTuple):
    """Law m = 1 - F_t / (mu F_z) of one contact."""

    rows: slice  # of F_x, F_y, F_z, m among the parameters
    coefficient: float
    margin_std: float  # to which it holds

    @classmethod
    def of(cls, contact: int, friction: Friction, parameters: Floats) -> "FrictionLaw":
        """Return the law of a contact, by index: the more friction its forces use, the less exact it is."""
        rows = slice(PARAMETERS * contact + FORCE_X, PARAMETERS * (contact + 1))
        used = used_friction(parameters[rows], friction.coefficient)
        return cls(rows, friction.coefficient, max(_EXACT_STD, used * friction.std / friction.coefficient))

    def breach(self, parameters: Floats) -> Breach:
        """Return how far parameters (7 k,) are from the law, and the slopes of that."""
        force_x, force_y, force_z, margin = parameters[self.rows].tolist()
        shear, friction = math.hypot(force_x, force_y), self.coefficient * force_z
        per_std = 1.0 / self.margin_std
        along = per_std / max(shear * friction, 1e-300)
        slopes = np.array([force_x * along, force_y * along, -shear * per_std / (friction * force_z), per_std])
        return Breach((margin - 1.0 + shear / friction) * per_std, slopes)


def used_friction(forces: Floats, coefficient: float) -> float:
    """Share of friction that forces F_x, F_y, F_z, .. use, at most 1."""
    force_x, force_y, force_z = forces[:3].tolist()
    return float(min(math.hypot(force_x, force_y) / (coefficient * max(force_z, 1e-300)), 1.0))


def add_laws(
    laws: Sequence[FrictionLaw], breaches: Sequence[Breach], gradient: Floats, precision: Floats
) -> tuple[Floats, Floats]:
    """Gradient (p,) and precision (p, p) of a chi-square with the laws, which are broken by so much."""
    gradient, precision = gradient.copy(), precision.copy()
    for law, (value, slopes) in zip(laws, breaches, strict=True):
        gradient[law.rows] -= value * slopes
        precision[law.rows, law.rows] += slopes * slopes[:, None]
    return gradient, precision


def sum_of_squares(breaches: Sequence[Breach]) -> float:
    return math.fsum(breach.value**2 for breach in breaches)


def are_linear(laws: Sequence[FrictionLaw], before: Sequence[Breach], after: Sequence[Breach], moved: Floats) -> bool:
    """Return whether breaches changed with the parameters, moved by (p,), as their slopes have it."""
    return all(
        abs(new.value - old.value - float(old.slopes @ moved[law.rows])) < _LINEAR
        for law, old, new in zip(laws, before, after, strict=True)
    )


def have_changed(before: Sequence[FrictionLaw], after: Sequence[FrictionLaw]) -> bool:
    """Return whether laws of the same contacts hold to another standard deviation."""
    return any(abs(new.margin_std / old.margin_std - 1.0) > _CHANGED for old, new in zip(before, after, strict=True))
