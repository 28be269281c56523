"""Eigenmodes of the signals' prior covariance: a frame in them, and the surface of a frame out of them."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from resonator_daemon.base.arrays import Floats, Indices, Singles

Transform = Callable[[Singles], Singles]

# A mode is left out where its signal stays a tenth of the noise, in frames up to 50 dB over the noise.
_FAINTEST = 1e-2
_POWER_RATIO = 1e5

_SUPPORT_SHARE = 0.1  # of the peak of f_z: under a contact, or next to it
_BORDER_RATIO = 1.5  # over that, at the border: the load goes on beyond


class Modes(ABC):
    """Whitened signals have the covariance q V diag(L) V' + 1 for a prior of scale q, the surface q F V' with them.

    Built in double precision, applied in single precision. k frames at once have modes (r, k) and fields (k, 3 m).
    """

    eigenvalues: Floats  # L, (r,)
    traction: Transform  # F times modes: (r,) to (3 m,)
    pressure: Transform  # the same of f_z alone: (m,)
    displacement: Transform  # the same of the displacement

    @abstractmethod
    def project(self, whitened: Singles) -> Singles:
        """V' times the whitened signals: (3 n,) to the modes (r,), or (k, 3 n) to (r, k)."""

    @abstractmethod
    def explained_variance(self, scales: Floats) -> Floats:
        """Variance of the traction that the signals explain, diagonal of q^2 F (q L + 1)^-1 F': (k,) to (k, 3 m)."""

    @abstractmethod
    def rows(self, signals: Indices) -> Floats:
        """Return the rows of V that belong to some of the signals, (len(signals), r)."""


class DenseModes(Modes):
    """Modes of any layout.

    Parameters
    ----------
    signals
        Covariance of the signals under the prior at scale 1, (3 n, 3 n).
    traction, displacement
        Covariance of the surface with the signals, (3 m, 3 n).
    noise_std
        Of each signal, (3 n,).
    scales
        Bank of scales, (k,).
    """

    def __init__(
        self, signals: Floats, traction: Floats, displacement: Floats, noise_std: Floats, scales: Floats
    ) -> None:
        eigenvalues, vectors = np.linalg.eigh(signals / noise_std[:, None] / noise_std)
        kept = min(scales.max(), _POWER_RATIO / eigenvalues.mean()) * eigenvalues > _FAINTEST
        self.eigenvalues, self._vectors = eigenvalues[kept], vectors[:, kept]
        scaled = self._vectors / noise_std[:, None]
        self._traction = (traction @ scaled).astype(np.float32)
        self._project = np.ascontiguousarray(self._vectors.T, np.float32)
        self.traction = partial(_field, self._traction)
        self.pressure = partial(_field, self._traction[-len(self._traction) // 3 :])
        self.displacement = partial(_field, (displacement @ scaled).astype(np.float32))

    def project(self, whitened: Singles) -> Singles:
        return self._project @ whitened.T

    def explained_variance(self, scales: Floats) -> Floats:
        gain = scales[:, None] ** 2 / (scales[:, None] * self.eigenvalues + 1.0)
        return np.asarray(gain @ (self._traction.astype(np.float64) ** 2).T, np.float64)

    def rows(self, signals: Indices) -> Floats:
        return self._vectors[signals]


def _field(matrix: Singles, modes: Singles) -> Singles:
    field: Singles = (matrix @ modes).T
    return field


@dataclass(frozen=True)
class Surface:
    """Surface of a frame, out of its modes."""

    modes: Modes
    amplitudes: Singles  # of the modes, (r,)
    declared_std: Floats  # posterior standard deviation of the traction at the declared noise, (3, m)
    excess: float  # factor of the standard deviation by noise beyond the declared one
    contact_factor: float  # further factor under a contact
    least_pressure: float  # that a contact may have
    border: Indices  # places at the border

    @cached_property
    def traction(self) -> Singles:
        """Traction, (3 m,)."""
        return self.modes.traction(self.amplitudes)

    @cached_property
    def pressure(self) -> Singles:
        """f_z, (m,)."""
        whole = self.__dict__.get("traction")
        return self.modes.pressure(self.amplitudes) if whole is None else whole[-whole.size // 3 :]

    @cached_property
    def displacement(self) -> Singles:
        """Displacement, (3 m,)."""
        return self.modes.displacement(self.amplitudes)

    def std(self) -> Floats:
        """Return the standard deviation of the traction, (3, m)."""
        under = self.pressure > self._threshold
        return self.declared_std * np.where(under, self.excess * self.contact_factor, self.excess)

    @cached_property
    def significance(self) -> float:
        """Largest pressure over its standard deviation."""
        highest = int(self.pressure.argmax())
        std = float(self.declared_std[2, highest]) * self.excess
        pressure = float(self.pressure[highest])
        return pressure / (std * self.contact_factor if pressure > self._threshold else std)

    @property
    def reaches_border(self) -> bool:
        """Whether the load goes on beyond the border."""
        at_border = float(self.pressure.take(self.border).max(initial=0.0))
        return at_border > _BORDER_RATIO * self._threshold

    @cached_property
    def _threshold(self) -> float:
        return max(_SUPPORT_SHARE * float(self.pressure.max()), self.least_pressure)
