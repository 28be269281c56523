"""Which shape presses, how curved and how deep: hypotheses fitted to the signals of a frame, compared by evidence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoded import SIGNAL_LIMIT
from resonator_daemon.estimate.surface.fitting.contact_fit import Fit, fit
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, PartialSlip, disc_starts
from resonator_daemon.estimate.surface.fitting.slip_fitter import fit_partial_slip
from resonator_daemon.estimate.surface.fitting.slip_signals import FORCE_Z, RADIUS

Kind = Literal["paraboloid", "flat", "edge"]

_EDGE_DIRECTIONS = np.arange(6) * np.pi / 6.0  # of which the best serves as start
_EDGE_WIDTH_START = 0.3  # of the start's radius

_LINE_NODES = 16  # closer than a depth for edges of up to 16 depths
_TILT_STEP_DEPTHS = 0.1  # from the centre to each of the two discs whose difference is a tilt


class FlatFace:
    """Round flat face of a rigid object that sticks.

    Parameters are x, y, a, F_x, F_y, F_z and T_x, T_y, the sums of x f_z and y f_z about the centre. A tilt adds the
    pressure 3 T_x x / (2 pi a^4) / sqrt(1 - r^2 / a^2) (Johnson, Contact Mechanics, 1985, section 5.3), which is the
    slope of a Hertz pressure, T_x by T_x, and taken as a difference of two.

    Parameters
    ----------
    flat, hertz
        Discs of both profiles over the same sites.
    """

    def __init__(self, flat: DiscModel, hertz: DiscModel) -> None:
        self._flat = flat
        self._hertz = hertz
        self._step_m = _TILT_STEP_DEPTHS * hertz.depth_m

    def __call__(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Return the signals (3 n,) and slopes (8, 3 n)."""
        centre, radius, force, moments = parameters[:2], float(parameters[2]), parameters[3:6], parameters[6:]
        face = self._flat.signals(centre, radius)
        columns = face.value.reshape(3, -1)
        slopes = np.vstack(
            [*(force @ part.reshape(3, -1) for part in (face.by_x, face.by_y, face.by_radius)), columns, columns[:2]]
        )
        value = force @ columns
        for axis, moment in enumerate(moments):
            step = self._step_m * np.eye(2)[axis]
            ahead, behind = self._hertz.signals(centre + step, radius), self._hertz.signals(centre - step, radius)
            tilt, by_x, by_y, by_radius = (
                (getattr(ahead, part)[2].ravel() - getattr(behind, part)[2].ravel()) / (2.0 * self._step_m)
                for part in ("value", "by_x", "by_y", "by_radius")
            )
            value += moment * tilt
            slopes[:3] += moment * np.array([by_x, by_y, by_radius])
            slopes[6 + axis] = tilt
        return value, slopes


class StraightEdge:
    """Straight edge that presses evenly over its length, a row of Hertz discs of one radius, its half width.

    Parameters are x, y, half width, F_x, F_y, F_z, direction from x and half length.
    """

    def __init__(self, hertz: DiscModel) -> None:
        self._hertz = hertz
        nodes, weights = np.polynomial.legendre.leggauss(_LINE_NODES)
        self._line = list(zip(nodes.tolist(), (weights / 2.0).tolist(), strict=True))

    def __call__(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Return the signals (3 n,) and slopes (8, 3 n)."""
        centre, radius, force = parameters[:2], float(parameters[2]), parameters[3:6]
        along = np.array([np.cos(parameters[6]), np.sin(parameters[6])])
        half_length = parameters[7]
        columns = np.zeros((3, 3 * len(self._hertz.sites_m)))
        slopes = np.zeros((8, columns.shape[1]))
        for node, weight in self._line:
            disc = self._hertz.signals(centre + node * half_length * along, radius)
            columns += weight * disc.value.reshape(3, -1)
            by_x, by_y, by_radius = (
                weight * (force @ part.reshape(3, -1)) for part in (disc.by_x, disc.by_y, disc.by_radius)
            )
            slopes[:3] += by_x, by_y, by_radius
            slopes[6] += node * half_length * (along[0] * by_y - along[1] * by_x)
            slopes[7] += node * (along[0] * by_x + along[1] * by_y)
        slopes[3:6] = columns
        return force @ columns, slopes


@dataclass(frozen=True)
class Shape:
    """The hypothesis of most evidence. Of the properties below it has those of its kind; the rest is NaN."""

    kind: Literal["paraboloid", "flat", "edge", "other"]  # "other": none explains the signals, or they are lost
    log_evidence: dict[Kind, float]  # less a constant: only differences count
    chi2: float  # of the best
    centre_m: Floats  # (2,)
    centre_std_m: Floats
    force_newton: Floats  # (3,)
    force_std_newton: Floats
    radius_m: float  # of contact; of an edge half its width
    radius_std_m: float
    radius_of_curvature_m: float = np.nan  # of a paraboloid
    radius_of_curvature_std_m: float = np.nan
    indentation_m: float = np.nan  # of a paraboloid or flat face
    indentation_std_m: float = np.nan
    tilt_rad: tuple[float, float] = (np.nan, np.nan)  # of a flat face: deeper towards x, towards y
    tilt_std_rad: tuple[float, float] = (np.nan, np.nan)
    direction_rad: float = np.nan  # of an edge, 0 .. pi from x
    direction_std_rad: float = np.nan
    length_m: float = np.nan  # of an edge
    length_std_m: float = np.nan


class ShapeFitter:
    """Fit of a paraboloid, which may slip in part, a flat round face, which may be tilted, and a straight edge.

    A sphere counts as a paraboloid: while strains are small, signals do not distinguish them.

    Parameters
    ----------
    half_space, site_positions_m, depth_m, radius_max_m
        As of `DiscModel`; errors, too.
    """

    def __init__(self, half_space: HalfSpace, site_positions_m: ArrayLike, depth_m: float, radius_max_m: float) -> None:
        self._hertz = DiscModel(half_space, site_positions_m, depth_m, radius_max_m)
        self._flat = DiscModel(half_space, site_positions_m, depth_m, radius_max_m, "flat")
        self._compliance = (1.0 - half_space.poisson_ratio**2) / half_space.youngs_modulus_pascal

    def fit(self, signals: ArrayLike, noise_std: ArrayLike, start: ContactStart) -> Shape:
        """Fit a frame with one contact; arguments and errors as of `fit_partial_slip`."""
        slip = fit_partial_slip(self._hertz, signals, noise_std, [start])[0]
        if np.isnan(slip.log_evidence):
            return _other(np.nan, {})
        frame = np.where(np.abs(signals) <= SIGNAL_LIMIT, signals, np.nan)
        noise = np.broadcast_to(np.asarray(noise_std, np.float64), frame.shape)
        flat = self._flat_face(frame.ravel(), noise.ravel(), start)
        edge = self._straight_edge(frame.ravel(), noise.ravel(), start)
        evidence: dict[Kind, float] = {
            "paraboloid": slip.log_evidence,
            "flat": flat.log_evidence,
            "edge": edge.log_evidence,
        }
        best = max(evidence, key=lambda kind: evidence[kind])
        if best == "paraboloid":
            return self._describe_paraboloid(slip, evidence)
        found = flat if best == "flat" else edge
        if found.doubt or not np.isfinite(found.covariance).all():
            return _other(found.chi2, evidence)
        return self._describe_flat(found, evidence) if best == "flat" else _describe_edge(found, evidence)

    def _flat_face(self, signals: Floats, noise_std: Floats, start: ContactStart) -> Fit:
        begin, lower, upper = disc_starts(self._flat, [start], signals, noise_std)
        limit = np.full(2, upper[FORCE_Z] * upper[RADIUS])
        lower, upper = np.concatenate([lower, -limit]), np.concatenate([upper, limit])
        return fit(FlatFace(self._flat, self._hertz), np.append(begin, [0.0, 0.0]), lower, upper, signals, noise_std)

    def _straight_edge(self, signals: Floats, noise_std: Floats, start: ContactStart) -> Fit:
        begin, lower, upper = disc_starts(self._hertz, [start], signals, noise_std)
        half_length_m = begin[0, RADIUS]
        begin[0, RADIUS] = max(_EDGE_WIDTH_START * half_length_m, lower[RADIUS])
        lower, upper = np.append(lower, [-np.inf, 0.0]), np.append(upper, [np.inf, self._hertz.margin_m / 2.0])
        model = StraightEdge(self._hertz)
        known = np.isfinite(signals)

        def chi_square(begin: Floats) -> float:
            left = (signals - model(begin)[0])[known] / noise_std[known]
            return float(left @ left)

        begins = [np.append(begin, [direction, half_length_m]) for direction in _EDGE_DIRECTIONS]
        return fit(model, min(begins, key=chi_square), lower, upper, signals, noise_std)

    def _describe_paraboloid(self, slip: PartialSlip, evidence: dict[Kind, float]) -> Shape:
        if np.isnan(slip.radius_m):
            return _other(slip.chi2, evidence)
        a, force = slip.radius_m, float(slip.force_newton[2])
        # a^3 = 3 F R (1 - nu^2) / (4 E), indentation a^2 / R (Johnson, section 4.2)
        curvature_m = 4.0 * a**3 / (3.0 * force * self._compliance)
        indentation_m = a**2 / curvature_m
        return Shape(
            "paraboloid",
            evidence,
            slip.chi2,
            slip.centre_m,
            slip.centre_std_m,
            slip.force_newton,
            slip.force_std_newton,
            a,
            slip.radius_std_m,
            radius_of_curvature_m=curvature_m,
            radius_of_curvature_std_m=_relative_std(slip.covariance, a, force, [3.0, -1.0]) * curvature_m,
            indentation_m=indentation_m,
            indentation_std_m=_relative_std(slip.covariance, a, force, [-1.0, 1.0]) * indentation_m,
        )

    def _describe_flat(self, found: Fit, evidence: dict[Kind, float]) -> Shape:
        a, force = found.parameters[RADIUS], found.parameters[FORCE_Z]
        std = np.sqrt(np.diag(found.covariance))
        # Indentation F (1 - nu^2) / (2 E a), tilt 3 T (1 - nu^2) / (4 E a^3) (Johnson, sections 3.4 and 5.3)
        indentation_m = force * self._compliance / (2.0 * a)
        per_moment = 0.75 * self._compliance / a**3
        tilt_x, tilt_y = found.parameters[6:] * per_moment
        tilt_std_x, tilt_std_y = std[6:] * per_moment
        return replace(
            _disc("flat", found, evidence),
            indentation_m=float(indentation_m),
            indentation_std_m=float(_relative_std(found.covariance, a, force, [-1.0, 1.0]) * indentation_m),
            tilt_rad=(float(tilt_x), float(tilt_y)),
            tilt_std_rad=(float(tilt_std_x), float(tilt_std_y)),
        )


def _relative_std(covariance: Floats, radius_m: float, force_newton: float, powers: Sequence[float]) -> float:
    """Return the relative standard deviation of a product of powers of radius and force, to first order."""
    relative = np.zeros(len(covariance))
    relative[[RADIUS, FORCE_Z]] = np.divide(powers, [radius_m, force_newton])
    return float(np.sqrt(relative @ covariance @ relative))


def _describe_edge(found: Fit, evidence: dict[Kind, float]) -> Shape:
    std = np.sqrt(np.diag(found.covariance))
    return replace(
        _disc("edge", found, evidence),
        direction_rad=float(found.parameters[6] % np.pi),
        direction_std_rad=float(std[6]),
        length_m=2.0 * float(found.parameters[7]),
        length_std_m=2.0 * float(std[7]),
    )


def _disc(kind: Kind, found: Fit, evidence: dict[Kind, float]) -> Shape:
    """State what all fits have in common."""
    one, std = found.parameters, np.sqrt(np.diag(found.covariance))
    return Shape(
        kind, evidence, found.chi2, one[:2], std[:2], one[3:6], std[3:6], float(one[RADIUS]), float(std[RADIUS])
    )


def _other(chi2: float, evidence: dict[Kind, float]) -> Shape:
    two, three = np.full(2, np.nan), np.full(3, np.nan)
    return Shape("other", evidence, chi2, two, two, three, three, np.nan, np.nan)
