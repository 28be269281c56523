"""What an array of sensors resolves of a load through noise and sampling: finest features, pitch and depth.

The load is white: its three components are independent, of equal density at all frequencies. The noise is white too,
equal and independent in every signal of every sensor; the signal-to-noise ratio is the root mean square of the array's
signals under this load over that of the noise, both over all components of the set. A frequency is judged by the best
linear estimate that is right whatever the load's other components are: "normal" whatever the shear, "shear" whatever
the pressure. It counts as resolved where the estimate's error has at most the density of the load, so that a Wiener
inverse keeps at least half of it. What the pitch folds onto a frequency from others counts as noise. A feature is half
a wavelength, the width of one stripe of a grating.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Complexes, Floats, Integers
from resonator_daemon.estimate.elastic.half_space import finite_array
from resonator_daemon.estimate.elastic.sensor_sets import SensorSet

Load = Literal["normal", "shear", "normal_alone"]

LOADS: Final[tuple[Load, ...]] = ("normal", "shear", "normal_alone")

_RESOLVED: Final = 1.0
_SNR_DB: Final = (-40.0, 100.0)
_PITCH_IN_DEPTHS_MAX: Final = 4.0
_LOWEST_IN_DEPTHS: Final = 1e-7  # of omega times depth: a load that is even, as far as sensors show
_DIRECTIONS: Final = np.radians(np.linspace(0.0, 90.0, 13))
_DEPTH_IN_FEATURES_MAX: Final = 10.0  # 100 dB end near a fourth of it
_DROWNED: Final = 1e-6  # power of a signal over that of the noise
_ZERO: Final = 1e-13  # a singular value below this share of the largest is rounding
_BORDER: Final = 1e-4  # relative, of a depth, pitch or frequency


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
        if load not in LOADS:
            raise ValueError(f"load is {load!r}, must be one of: {', '.join(LOADS)}")
        wx, wy = np.broadcast_arrays(finite_array("omega_x", omega_x), finite_array("omega_y", omega_y))
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

    def features_m(self, load: Load, directions_rad: ArrayLike | None = None) -> tuple[float, float]:
        """Finest and coarsest features that are resolved, and all between them.

        Features are the stripes of gratings whose wave vectors have these directions; without directions those of all.
        The coarsest is infinite where even loads are resolved. Both are NaN where nothing is. Where the resolved
        frequencies of a direction fall apart, the highest stretch counts.
        """
        directions = self._directions if directions_rad is None else finite_array("directions_rad", directions_rad)
        directions = np.atleast_1d(directions)
        if not directions.size:
            raise ValueError("directions_rad is empty, must hold at least one direction")
        bands = [self._band(load, d) for d in directions.tolist()]
        low, high = np.max(bands * np.array([1.0, -1.0]), axis=0) * [1.0, -1.0]
        if not low < high:
            return np.nan, np.nan
        return float(np.pi / high), float(np.pi / low) if low > 0.0 else np.inf

    def deepest_m(self, load: Load, feature_m: float) -> float:
        """Largest depth, of up to ten features, at which this set, pitch and ratio resolve one; NaN where none does.

        A ValueError refuses a feature that is not finite and above 0.
        """
        _check_feature(feature_m)
        if feature_m < self.pitch_m:
            return np.nan
        depths = np.geomspace(_DEPTH_IN_FEATURES_MAX * feature_m, self.pitch_m / _PITCH_IN_DEPTHS_MAX * 1.001, 40)

        def resolved(depth_m: float) -> bool:
            sensors = replace(self.sensors, depth_m=depth_m)
            return self._resolves(replace(self, sensors=sensors), load, feature_m)

        for depth, above in zip(depths[1:], depths, strict=False):
            if resolved(depth):
                return _last_resolved(resolved, depth, above)
        return np.nan

    def widest_pitch_m(self, load: Load, feature_m: float) -> float:
        """Largest pitch at which this set, depth and ratio resolve a feature in all directions.

        NaN where not even a thousandth of the feature does. The ratio is that of one sensor: a finer pitch averages
        over more of them. A ValueError refuses a feature that is not finite and above 0.
        """
        _check_feature(feature_m)

        def resolved(pitch_m: float) -> bool:
            return self._resolves(replace(self, pitch_m=pitch_m), load, feature_m)

        widest = min(feature_m, _PITCH_IN_DEPTHS_MAX * self.sensors.depth_m)
        if resolved(widest):
            return widest
        return _last_resolved(resolved, 1e-3 * widest, widest) if resolved(1e-3 * widest) else np.nan

    @property
    def _directions(self) -> Floats:
        """Directions that stand for all: a reflection of an axis changes no more than the signs of signals."""
        return np.union1d(_DIRECTIONS, [d for d in self.sensors.blind_directions_rad if d <= np.pi / 2.0])

    def _resolves(self, array: "SensorArray", load: Load, feature_m: float) -> bool:
        """Return whether an array, of another depth or pitch than this one, resolves a feature in all directions."""
        omega, directions = np.pi / feature_m, self._directions
        return bool(
            (array.load_to_error(load, omega * np.cos(directions), omega * np.sin(directions)) >= _RESOLVED).all()
        )

    @cached_property
    def _bands(self) -> dict[tuple[Load, float], Floats]:
        """Bands by load and direction, as they are found."""
        return {}

    def _band(self, load: Load, direction_rad: float) -> Floats:
        """Lowest and highest frequency of the highest stretch that is resolved; NaN where nothing is."""
        asked = load, direction_rad
        if asked not in self._bands:
            self._bands[asked] = self._find_band(load, direction_rad)
        return self._bands[asked]

    def _find_band(self, load: Load, direction_rad: float) -> Floats:
        c, s = np.cos(direction_rad), np.sin(direction_rad)
        nyquist = np.pi / (self.pitch_m * max(abs(c), abs(s)))
        omega = np.geomspace(_LOWEST_IN_DEPTHS / self.sensors.depth_m, nyquist, 150)

        def resolved(omega: float) -> bool:
            return bool(self.load_to_error(load, omega * c, omega * s) >= _RESOLVED)

        good = np.flatnonzero(self.load_to_error(load, omega * c, omega * s) >= _RESOLVED)
        if not good.size:
            return np.array([np.nan, np.nan])
        last = int(good[-1])
        high = nyquist if last == omega.size - 1 else _last_resolved(resolved, omega[last], omega[last + 1])
        bad = np.setdiff1d(np.arange(last), good)
        low = _last_resolved(resolved, omega[bad[-1] + 1], omega[bad[-1]]) if bad.size else 0.0
        return np.array([low, high])


def _weakest(wanted: Complexes, unknown: Complexes) -> Floats:
    """Return the least power, shape (n,), that is left of signals (n, rows, k) of unit loads among unknown others.

    Least over the combinations of the wanted loads; what is left is what no combination of the unknown ones can cause.
    """
    if unknown.shape[-1]:
        basis, strength, _ = np.linalg.svd(unknown, full_matrices=False)
        scale = np.linalg.norm(wanted, axis=(1, 2)) + strength[:, 0]
        basis = basis * (strength > _ZERO * scale[:, None])[:, None]
        wanted = wanted - basis @ (basis.conj().swapaxes(-1, -2) @ wanted)
    return np.asarray(np.linalg.eigvalsh(wanted.conj().swapaxes(-1, -2) @ wanted)[:, 0].clip(min=0.0), np.float64)


def _check_feature(feature_m: float) -> None:
    if not 0.0 < feature_m < np.inf:
        raise ValueError(f"feature_m is {feature_m}, must be finite and above 0")


def _last_resolved(resolved: Callable[[float], bool], inside: float, outside: float) -> float:
    """Bisect for the border of what is resolved; the value returned is resolved."""
    while abs(outside - inside) > _BORDER * abs(inside):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if resolved(middle) else (inside, middle)
    return float(inside)
