"""What a set of stress and strain components at one depth shows of the load: rank, spectra, bandwidth and symmetry."""

from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cache, cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import roots_laguerre

from resonator_daemon.base.arrays import Complexes, Floats, Integers
from resonator_daemon.estimate.elastic.half_space import HalfSpace, Output

Loss = Literal["none", "too_few", "incompressible", "dependent"]

_TENSOR: Final = ("xx", "yy", "zz", "xy", "xz", "yz")
_ROWS: Final[dict[str, tuple[Output, int]]] = {
    "p_n": ("p_n", 0),
    **{name: ("strain", row) for row, name in enumerate(_TENSOR)},
    **{f"sigma_{name}": ("stress", row) for row, name in enumerate(_TENSOR)},
}

COMPONENTS: Final = tuple(_ROWS)
"""Mean normal stress p_n, the six strains, the six stresses."""

_DEPTHS_M: Final = (1e-9, 1e3)
_DEPTHS_MAX: Final = 600.0  # of omega times depth: signals fade as its exponential, which ends at 745
_ZERO: Final = 1e-12  # a singular value below this times exp(-omega depth) is rounding
_NEARLY_ZERO: Final = 1e-6  # the same at a direction found by search
_STEEPEST: Final = 0.2  # more than the same changes within a degree
_LIMIT: Final = 1e-9  # omega times depth that stands for the limit along a direction
_SAMPLES: Final = np.array([0.31, 0.93, 2.17])  # omega times depth at which the rank in every direction is judged
_DEGREES: Final = np.radians(np.arange(180.0))


@dataclass(frozen=True)
class SensorSet:
    """Stress and strain components that are sensed together, everywhere on the plane at one depth.

    Signals are dimensionless: 3 p_n / (2 E), the tensor strains as they are, stresses / (2 mu). Tractions count in
    units of 2 mu, so that nothing here depends on Young's modulus; a signal per pascal is an entry over 2 mu.

    Parameters
    ----------
    half_space
    components
        One or more of `COMPONENTS`, each once.
    depth_m
        From a nanometre to a kilometre.

    Raises
    ------
    ValueError
        No component, one that is unknown or named twice, or a depth out of its range.
    """

    half_space: HalfSpace
    components: tuple[str, ...]
    depth_m: float

    def __post_init__(self) -> None:
        if not self.components:
            raise ValueError(f"components is empty, must name at least one of: {', '.join(COMPONENTS)}")
        for name in self.components:
            if name not in _ROWS:
                plain = name.lower().removeprefix("eps_")
                swapped = plain[:-2] + plain[:-3:-1]  # zx for xz
                meant = [other for other in (plain, swapped) if other in COMPONENTS]
                near = meant or get_close_matches(plain, COMPONENTS, 1, cutoff=0.4)
                hint = f"did you mean {near[0]}? " if near else ""
                raise ValueError(f"component {name!r} is unknown; {hint}must be one of: {', '.join(COMPONENTS)}")
            if self.components.count(name) > 1:
                raise ValueError(f"component {name!r} is named {self.components.count(name)} times, must be once")
        low, high = _DEPTHS_M
        if not low <= self.depth_m <= high:
            raise ValueError(f"depth_m is {self.depth_m:g}, must be from {low:g} to {high:g}")

    def matrix(self, omega_x: ArrayLike, omega_y: ArrayLike) -> Complexes:
        """Return the signals per traction over 2 mu, rows as `components`, columns x, y, z.

        Parameters
        ----------
        omega_x, omega_y
            Spatial frequencies in rad/m, of shapes that broadcast. At omega = 0, where most entries have no limit that
            all directions share, stands the mean over all directions.

        Returns
        -------
        array
            Complex, shape (..., n, 3).

        Raises
        ------
        ValueError
            A frequency that is not finite, or above 600 over the depth, where signals are too small for a number.
        """
        self._check_range(omega_x, omega_y)
        body, nu = self.half_space, self.half_space.poisson_ratio
        scales: dict[Output, float] = {
            "p_n": 3.0 / (2.0 * (1.0 + nu)),
            "strain": 2.0 * body.shear_modulus_pascal,
            "stress": 1.0,
        }
        rows = [_ROWS[name] for name in self.components]
        blocks = {
            output: scales[output] * body.transfer_matrix(output, "traction", omega_x, omega_y, self.depth_m)
            for output in dict.fromkeys(output for output, _ in rows)
        }
        return np.stack([blocks[output][..., row, :] for output, row in rows], axis=-2)

    def singular_values(self, omega_x: ArrayLike, omega_y: ArrayLike) -> Floats:
        """Singular values of `matrix`, shape (..., 3), falling; 0 for those that fewer than three components lack."""
        found = np.linalg.svd(self.matrix(omega_x, omega_y), compute_uv=False)
        values = np.zeros((*found.shape[:-1], 3))
        values[..., : found.shape[-1]] = found
        return values

    def rank(self, omega_x: ArrayLike, omega_y: ArrayLike) -> Integers:
        """How many of the load's three components show: singular values above 1e-12 exp(-omega depth)."""
        known = self.singular_values(omega_x, omega_y) > _ZERO * self._fading(omega_x, omega_y)
        return np.asarray(known.sum(axis=-1), np.int64)

    def condition(self, omega_x: ArrayLike, omega_y: ArrayLike) -> Floats:
        """Largest singular value over the third one; infinite where the rank is below 3."""
        values = self.singular_values(omega_x, omega_y)
        full = values[..., 2] > _ZERO * self._fading(omega_x, omega_y)[..., 0]
        ratio = np.full(full.shape, np.inf)
        ratio[full] = values[full, 0] / values[full, 2]
        return ratio

    def power(self, omega_x: ArrayLike, omega_y: ArrayLike) -> Floats:
        """Power spectrum of each signal under a white load, the squared norm of its row of `matrix`; shape (..., n).

        The load's components are independent, of unit density each. The set's power is the sum over its rows.
        """
        matrix = self.matrix(omega_x, omega_y)
        return np.asarray((matrix.real**2 + matrix.imag**2).sum(axis=-1), np.float64)

    @cached_property
    def power_integral_per_m2(self) -> float:
        """Integral of the set's power over the plane of frequencies, in rad^2/m^2.

        Over 4 pi^2 it is the sum of the signals' variances under a white load of unit density.
        """
        t, weight = _radial_quadrature(2.0, 2)  # exact: t times squares of entries linear in t
        around = self.power(*self._rings(t, _DEGREES[::9])).sum(axis=-1)  # exact: of degree 8 in direction
        return 2.0 * np.pi * float(weight @ around.mean(axis=1)) / self.depth_m**2

    @cached_property
    def highest_power(self) -> float:
        """Maximum of the set's power over the whole plane; its root over 2 mu is the strongest signal per pascal."""
        t = np.concatenate([[_LIMIT], np.linspace(0.01, 4.0, 400)])
        return float(self.power(*self._rings(t)).sum(axis=-1).max())

    @property
    def bandwidth_rad_per_m(self) -> float:
        """Noise-equivalent bandwidth: the radius of the disc that holds the set's power at its highest density.

        sqrt(integral / (pi max)); 1 / (sqrt(2) depth) for p_n alone.
        """
        return float(np.sqrt(self.power_integral_per_m2 / (np.pi * self.highest_power)))

    @cached_property
    def asymmetry(self) -> float:
        """Relative spread over direction of the squared singular values; 0 for a set that has no favoured direction.

        The root of: integral of the squared deviation from the mean over directions, over the integral of the squared
        mean, both summed over the three. For a single component it is the spread of that component's power.
        """
        t, weight = _radial_quadrature(4.0, 24)
        squares = self.singular_values(*self._rings(t)) ** 2
        mean = squares.mean(axis=1)
        deviation = ((squares - mean[:, None]) ** 2).mean(axis=1)
        return float(np.sqrt(weight @ deviation.sum(axis=-1) / (weight @ (mean**2).sum(axis=-1))))

    @cached_property
    def best_rank(self) -> int:
        """Rank at all frequencies but exceptional ones."""
        return int(self.rank(*self._rings(_SAMPLES)).max())

    @cached_property
    def blind_directions_rad(self) -> tuple[float, ...]:
        """Directions of omega, in [0, pi), in which the rank is below `best_rank` at every frequency.

        A load that varies only along such a direction is missed in part.
        """
        from scipy.optimize import minimize_scalar  # here: as slow to import as all the rest, and a daemon needs it not

        def left(direction: float | Floats) -> Floats:
            omega = self._rings(_SAMPLES, np.atleast_1d(direction))
            values = self.singular_values(*omega) / self._fading(*omega)
            return np.asarray(values[..., self.best_rank - 1].max(axis=0))

        on_grid = left(_DEGREES)
        lowest = (on_grid <= np.roll(on_grid, 1)) & (on_grid <= np.roll(on_grid, -1))
        found = []
        scale = float(on_grid.max())  # small in all directions near poisson_ratio 1/2
        for direction in _DEGREES[lowest & (on_grid < _STEEPEST * scale)]:
            if left(direction)[0] < _ZERO * scale:
                found.append(float(direction))
                continue
            step = _DEGREES[1]
            best = minimize_scalar(
                lambda angle: left(angle)[0],
                bounds=(direction - step, direction + step),
                method="bounded",
                options={"xatol": 1e-10},
            )
            if best.fun < _NEARLY_ZERO * scale:
                found.append(float(best.x % np.pi))
        return tuple(found)

    @cached_property
    def loss(self) -> Loss:
        """Why not all three components of a load can be distinguished, whatever the direction and frequency.

        "too_few": fewer than three components. "incompressible": volume is kept, so that the strains show nothing of
        the mean stress; the same set has a higher rank for a Poisson's ratio below 1/2. "dependent": its components
        follow from each other, as in-plane strains at one depth do by compatibility.
        """
        if self.best_rank == 3:
            return "none"
        if self.half_space.poisson_ratio < 0.5:
            return "too_few" if self.best_rank == len(self.components) else "dependent"
        compressible = replace(self, half_space=HalfSpace(self.half_space.youngs_modulus_pascal, 0.3))
        if compressible.best_rank > self.best_rank:
            return "incompressible"
        return "too_few" if self.best_rank == len(self.components) else "dependent"

    def _rings(self, t: Floats, directions_rad: Floats = _DEGREES) -> tuple[Floats, Floats]:
        """Return omega_x, omega_y of shape (t, directions) for t = omega times depth."""
        omega = t[:, None] / self.depth_m
        return omega * np.cos(directions_rad), omega * np.sin(directions_rad)

    def _fading(self, omega_x: ArrayLike, omega_y: ArrayLike) -> Floats:
        return np.asarray(np.exp(-self.depth_m * np.hypot(omega_x, omega_y))[..., None], np.float64)

    def _check_range(self, omega_x: ArrayLike, omega_y: ArrayLike) -> None:
        highest = float(np.max(np.hypot(omega_x, omega_y), initial=0.0))
        if highest * self.depth_m > _DEPTHS_MAX:
            limit = _DEPTHS_MAX / self.depth_m
            raise ValueError(f"omega reaches {highest:g} rad/m, must be at most {limit:g} at depth_m {self.depth_m:g}")


@cache
def _radial_quadrature(fading: float, count: int) -> tuple[Floats, Floats]:
    """Return the nodes and weights for the integral over t of t g(t), g a smooth function times exp(-fading t)."""
    nodes, weights = roots_laguerre(count)
    t = nodes / fading
    return t, weights * np.exp(nodes) * t / fading
