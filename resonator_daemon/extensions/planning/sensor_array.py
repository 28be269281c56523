"""Sets of sensors under a skin, and what an array of them resolves: rank, spectra, symmetry, finest features.

The load is white: its three components are independent, of equal density at all frequencies. The noise is white too,
equal and independent in every signal of every sensor; the signal-to-noise ratio is the root mean square of the array's
signals under this load over that of the noise, both over all components of the set. A frequency is judged by the best
linear estimate that is right whatever the load's other components are: "normal" whatever the shear, "shear" whatever
the pressure. It counts as resolved where the estimate's error has at most the density of the load, so that a Wiener
inverse keeps at least half of it. What the pitch folds onto a frequency from others counts as noise. A feature is half
a wavelength, the width of one stripe of a grating.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar
from scipy.special import roots_laguerre

from resonator_daemon.base.arrays import Complexes, Floats, Integers
from resonator_daemon.estimate.elastic.half_space import HalfSpace, Output

Loss = Literal["none", "too_few", "incompressible", "dependent"]
Load = Literal["normal", "shear", "normal_alone"]

LOADS: Final[tuple[Load, ...]] = ("normal", "shear", "normal_alone")

_TENSOR: Final = ("xx", "yy", "zz", "xy", "xz", "yz")
_ROWS: Final[dict[str, tuple[Output, int]]] = {
    "p_n": ("p_n", 0),
    **{name: ("strain", row) for row, name in enumerate(_TENSOR)},
    **{f"sigma_{name}": ("stress", row) for row, name in enumerate(_TENSOR)},
}

COMPONENTS: Final = tuple(_ROWS)
"""Mean normal stress p_n, the six strains, the six stresses."""

_DEPTHS_M: Final = (1e-9, 1e3)
_ZERO: Final = 1e-12  # a singular value below this times exp(-omega depth) is rounding
_NEARLY_ZERO: Final = 1e-6  # the same at a direction found by search
_STEEPEST: Final = 0.2  # more than the same changes within a degree
_LIMIT: Final = 1e-9  # omega times depth that stands for the limit along a direction
_SAMPLES: Final = np.array([0.31, 0.93, 2.17])  # omega times depth at which the rank in every direction is judged
_DEGREES: Final = np.radians(np.arange(180.0))
_RESOLVED: Final = 1.0
_SNR_DB: Final = (-40.0, 100.0)
_PITCH_IN_DEPTHS_MAX: Final = 4.0
_LOWEST_IN_DEPTHS: Final = 1e-7  # of omega times depth: a load that is even, as far as sensors show
_DIRECTIONS: Final = np.radians(np.linspace(0.0, 90.0, 13))
_DROWNED: Final = 1e-6  # power of a signal over that of the noise
_CONFUSED: Final = 1e-13  # a singular value below this share of the largest is rounding
_BORDER: Final = 1e-4  # relative, of a frequency


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
                raise ValueError(f"component {name!r} is unknown; must be one of: {', '.join(COMPONENTS)}")
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
        """
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
        """Singular values of `matrix`, falling, at most three, relative to the fading exp(-omega depth) of signals."""
        values = np.linalg.svd(self.matrix(omega_x, omega_y), compute_uv=False)
        return np.asarray(values * np.exp(self.depth_m * np.hypot(omega_x, omega_y))[..., None], np.float64)

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
        squares = self.singular_values(*self._rings(t)) ** 2 * np.exp(-2.0 * t)[:, None, None]
        mean = squares.mean(axis=1)
        deviation = ((squares - mean[:, None]) ** 2).mean(axis=1)
        return float(np.sqrt(weight @ deviation.sum(axis=-1) / (weight @ (mean**2).sum(axis=-1))))

    @cached_property
    def best_rank(self) -> int:
        """Rank at all frequencies but exceptional ones."""
        return int((self.singular_values(*self._rings(_SAMPLES)) > _ZERO).sum(axis=-1).max())

    @cached_property
    def blind_directions_rad(self) -> tuple[float, ...]:
        """Directions of omega, in [0, pi), in which the rank is below `best_rank` at every frequency.

        A load that varies only along such a direction is missed in part.
        """

        def left(direction: float | Floats) -> Floats:
            values = self.singular_values(*self._rings(_SAMPLES, np.atleast_1d(direction)))
            return np.asarray(values[..., self.best_rank - 1].max(axis=0))

        on_grid = left(_DEGREES)
        lowest = (on_grid <= np.roll(on_grid, 1)) & (on_grid <= np.roll(on_grid, -1))
        scale = float(on_grid.max())  # small in all directions near poisson_ratio 1/2
        found = []
        for direction in _DEGREES[lowest & (on_grid < _STEEPEST * scale)]:
            around = (direction - _DEGREES[1], direction + _DEGREES[1])
            best = minimize_scalar(
                lambda angle: left(angle)[0], bounds=around, method="bounded", options={"xatol": 1e-10}
            )
            if best.fun < _NEARLY_ZERO * scale:
                found.append(math.radians(round(math.degrees(best.x), 6) % 180.0))
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
        compressible = replace(self, half_space=HalfSpace(self.half_space.youngs_modulus_pascal, 0.3))
        if self.half_space.poisson_ratio == 0.5 and compressible.best_rank > self.best_rank:
            return "incompressible"
        return "too_few" if self.best_rank == len(self.components) else "dependent"

    def _rings(self, t: Floats, directions_rad: Floats = _DEGREES) -> tuple[Floats, Floats]:
        """Return omega_x, omega_y of shape (t, directions) for t = omega times depth."""
        omega = t[:, None] / self.depth_m
        return omega * np.cos(directions_rad), omega * np.sin(directions_rad)


class Features(NamedTuple):
    """Finest and coarsest features, with all between them, that are resolved in all directions; finest in the best.

    The coarsest is infinite where even loads are resolved. NaN where nothing is. Where the resolved frequencies of a
    direction fall apart, the highest stretch counts.
    """

    finest_m: float
    coarsest_m: float
    finest_in_best_direction_m: float


@dataclass(frozen=True)
class SensorArray:
    """A sensor set at the points of a square lattice, and its noise.

    Parameters
    ----------
    sensors
    pitch_m
        Spacing of the lattice along x and y; above 0, at most four times the depth, beyond which nearly all of the
        signal lies between the sensors.
    snr_db
        20 log10 of the rms of the signals under a white load over the rms of the noise, from -40 to 100.

    Raises
    ------
    ValueError
        A pitch or ratio outside its range.
    """

    sensors: SensorSet
    pitch_m: float
    snr_db: float

    def __post_init__(self) -> None:
        pitch_max_m = _PITCH_IN_DEPTHS_MAX * self.sensors.depth_m
        if not 0.0 < self.pitch_m <= pitch_max_m:
            raise ValueError(
                f"pitch_m is {self.pitch_m:g}, must be above 0 and at most four depths, {pitch_max_m:g}: "
                "a sparser array misses what lies between its sensors; choose a smaller pitch or a larger depth"
            )
        low, high = _SNR_DB
        if not low <= self.snr_db <= high:
            raise ValueError(f"snr_db is {self.snr_db:g}, must be from {low:g} to {high:g}")

    @property
    def noise_density(self) -> float:
        """Density of the noise of one signal over that of a traction in units of 2 mu, as `SensorSet.matrix` counts."""
        variance = self.sensors.power_integral_per_m2 / (4.0 * np.pi**2)
        ratio = len(self.sensors.components) * 10.0 ** (self.snr_db / 10.0)
        return float(variance * self.pitch_m**2 / ratio)

    def load_to_error(self, load: Load, omega_x: ArrayLike, omega_y: ArrayLike) -> Floats:
        """Density of a load over that of its estimate's error, r; shape (...). A Wiener inverse keeps r / (1 + r).

        Parameters
        ----------
        load
            "normal": f_z, whatever the shear. "shear": tangential traction in the direction that is known worst,
            whatever f_z. "normal_alone": f_z of a load that is known to have no shear, under the same noise.
        omega_x, omega_y
            In rad/m, of shapes that broadcast. Beyond the Nyquist frequency pi / pitch along x or y the result is 0,
            and where signals are a millionth of the noise.
        """
        wx, wy = np.broadcast_arrays(omega_x, omega_y)
        nyquist = np.pi / self.pitch_m * (1.0 + 1e-12)
        inside = (np.abs(wx) <= nyquist) & (np.abs(wy) <= nyquist) & (np.hypot(wx, wy) <= self._omega_seen)
        ratio = np.zeros(wx.shape)
        ratio[inside] = self._load_to_error_inside(load, wx[inside], wy[inside])
        return ratio

    def _load_to_error_inside(self, load: Load, wx: Floats, wy: Floats) -> Floats:
        columns = slice(2, 3) if load == "normal_alone" else slice(0, 3)
        folds = 2.0 * np.pi / self.pitch_m * self._folds()
        every = self.sensors.matrix(wx[:, None] + folds[:, 0], wy[:, None] + folds[:, 1])[..., columns]
        here, folded = every[:, 0], every[:, 1:]
        count, rows = len(wx), len(self.sensors.components)
        folded = np.moveaxis(folded, 1, 2).reshape(count, rows, folded.shape[1] * folded.shape[3])
        covariance = self.noise_density * np.eye(rows) + folded @ folded.conj().swapaxes(-1, -2)
        whitened = np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), here), np.complex128)
        if load == "shear":
            return _weakest(whitened[..., :2], whitened[..., 2:])
        return _weakest(whitened[..., -1:], whitened[..., :-1])

    @property
    def _omega_seen(self) -> float:
        """Frequency in rad/m above which signals, about (1 + t^2) exp(-2 t) of t = omega depth, drown in noise."""
        return 0.5 * float(np.log(1.0 / (_DROWNED * min(self.noise_density, 1.0)))) / self.sensors.depth_m

    def _folds(self) -> Integers:
        """Return which multiples (n, 2) of the sampling frequency fold signals onto a frequency, itself first."""
        reach = int(0.5 + self._omega_seen * self.pitch_m / (2.0 * np.pi))
        steps = np.arange(-reach, reach + 1)
        folds = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        return folds[np.argsort(np.abs(folds).sum(axis=1), kind="stable")]

    def features(self, load: Load) -> Features:
        """Return what gratings are resolved in all directions, and in the best."""
        blind = [d for d in self.sensors.blind_directions_rad if d <= np.pi / 2.0]  # a reflection changes signs only
        bands = np.array([self.band(load, d) for d in [*_DIRECTIONS.tolist(), *blind]])
        (low, _), (_, high) = bands.max(axis=0), bands.min(axis=0)
        best_m = float(np.pi / np.nanmax(bands[:, 1])) if np.isfinite(bands).any() else np.nan
        if not low < high:
            return Features(np.nan, np.nan, best_m)
        return Features(float(np.pi / high), float(np.pi / low) if low > 0.0 else np.inf, best_m)

    def band(self, load: Load, direction_rad: float) -> tuple[float, float]:
        """Lowest and highest frequency of the highest stretch that is resolved in a direction; NaN where nothing is."""
        c, s = np.cos(direction_rad), np.sin(direction_rad)
        nyquist = np.pi / (self.pitch_m * max(abs(c), abs(s)))
        omega = np.geomspace(_LOWEST_IN_DEPTHS / self.sensors.depth_m, nyquist, 150)

        def resolved(omega: float) -> bool:
            return bool(self.load_to_error(load, omega * c, omega * s) >= _RESOLVED)

        good = np.flatnonzero(self.load_to_error(load, omega * c, omega * s) >= _RESOLVED)
        if not good.size:
            return np.nan, np.nan
        last = int(good[-1])
        high = nyquist if last == omega.size - 1 else _last_resolved(resolved, omega[last], omega[last + 1])
        bad = np.setdiff1d(np.arange(last), good)
        low = _last_resolved(resolved, omega[bad[-1] + 1], omega[bad[-1]]) if bad.size else 0.0
        return low, high


def _weakest(wanted: Complexes, unknown: Complexes) -> Floats:
    """Return the least power, shape (n,), that is left of signals (n, rows, k) of unit loads among unknown others.

    Least over the combinations of the wanted loads; what is left is what no combination of the unknown ones can cause.
    """
    if unknown.shape[-1]:
        basis, strength, _ = np.linalg.svd(unknown, full_matrices=False)
        scale = np.linalg.norm(wanted, axis=(1, 2)) + strength[:, 0]
        basis = basis * (strength > _CONFUSED * scale[:, None])[:, None]
        wanted = wanted - basis @ (basis.conj().swapaxes(-1, -2) @ wanted)
    return np.asarray(np.linalg.eigvalsh(wanted.conj().swapaxes(-1, -2) @ wanted)[:, 0].clip(min=0.0), np.float64)


def _last_resolved(resolved: Callable[[float], bool], inside: float, outside: float) -> float:
    """Bisect for the border of what is resolved; the value returned is resolved."""
    while abs(outside - inside) > _BORDER * abs(inside):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if resolved(middle) else (inside, middle)
    return float(inside)


@cache
def _radial_quadrature(fading: float, count: int) -> tuple[Floats, Floats]:
    """Return the nodes and weights for the integral over t of t g(t), g a smooth function times exp(-fading t)."""
    nodes, weights = roots_laguerre(count)
    t = nodes / fading
    return t, weights * np.exp(nodes) * t / fading
