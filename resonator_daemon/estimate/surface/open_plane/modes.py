"""Eigenmodes of the signals' prior covariance: a frame in them, the scale of the prior, and the surface out of them."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats, Indices, Singles

Transform = Callable[[Singles], Singles]

# A mode is left out where its signal stays a tenth of the noise, in frames up to 50 dB over the noise.
_FAINTEST = 1e-2
_POWER_RATIO = 1e5

_SUPPORT_SHARE = 0.1  # of the peak of f_z: under a contact, or next to it
_BORDER_RATIO = 1.5  # over that, at the border: the load goes on beyond

_STRIDE = 5  # the likelihood of every fifth scale is computed; a parabola finds the best one between them


class Modes(ABC):
    """Whitened signals have the covariance q V diag(L) V' + 1 for a prior of scale q, the surface q F V' with them.

    Built in double precision, applied in single precision.
    """

    eigenvalues: Floats  # L, (r,)
    traction: Transform  # F times modes: (r,) to (3 m,)
    pressure: Transform  # the same of f_z alone: (m,)
    displacement: Transform  # the same of the displacement
    signals: Transform  # V times modes: (r,) to the whitened signals (3 n,)

    @abstractmethod
    def project(self, whitened: Singles) -> Singles:
        """V' times the whitened signals: (3 n,) to the modes (r,)."""

    @abstractmethod
    def explained_variance(self, scales: Floats) -> Floats:
        """Variance of the traction that the signals explain, diagonal of q^2 F (q L + 1)^-1 F': (k,) to (k, 3 m)."""

    @abstractmethod
    def explained_signals(self, weights: Floats) -> Floats:
        """Return the diagonal of V diag(weights) V': (r,) to (3 n,)."""

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
        self.signals = partial(_field, self._project.T)

    def project(self, whitened: Singles) -> Singles:
        return self._project @ whitened

    def explained_variance(self, scales: Floats) -> Floats:
        gain = scales[:, None] ** 2 / (scales[:, None] * self.eigenvalues + 1.0)
        return np.asarray(gain @ (self._traction.astype(np.float64) ** 2).T, np.float64)

    def explained_signals(self, weights: Floats) -> Floats:
        return np.asarray(self._vectors**2 @ weights, np.float64)

    def rows(self, signals: Indices) -> Floats:
        return self._vectors[signals]


def _field(matrix: Singles, modes: Singles) -> Singles:
    return matrix @ modes


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


class Choice(NamedTuple):
    """The scale that explains one frame best."""

    scale: int  # index in the grid
    chi2: float  # mean square of the innovation in units of prior and noise
    excess: float  # noise variance over the declared one, at least 1
    log_evidence: float


class ScaleGrid:
    """Scales q of the prior, and what each makes of whitened signals with covariance q V diag(L) V' + 1.

    Besides the scale a common factor of prior and noise is maximised over, at least 1: where gain errors or a depth
    that is wrong leave more than the noise, the excess counts as noise. Without that, small noise would make errors
    of the model explode.

    Parameters
    ----------
    eigenvalues
        L, (r,), at least 0.
    scales
        Values of q, evenly spaced in their logarithm, (k,).
    log_noise
        Logarithm of the noise's standard deviation, for each signal; signals outside the r modes hold noise alone.
    """

    def __init__(self, eigenvalues: Floats, scales: Floats, log_noise: Floats) -> None:
        power = scales[:, None] * eigenvalues + 1.0
        self.scales = scales
        self.gain = (scales[:, None] / power).astype(np.float32)  # (k, r): from modes of the signals to the surface's
        self.explained = 1.0 - 1.0 / power  # (k, r): share of a mode that is not noise
        self._left = (1.0 / power).astype(np.float32)
        self._left_coarse = self._left[::_STRIDE].copy()
        self._log_det = np.log(power).sum(axis=1)
        self._log_det_coarse = self._log_det[::_STRIDE].copy()
        self._log_noise = log_noise
        self._constant = 2.0 * float(log_noise.sum())
        self._samples = log_noise.size

    def choose(self, modes: Singles, energy: float, floor: float) -> Choice:
        """Maximise the likelihood for modes (r,) and the sum of squares of all whitened signals.

        `floor` is the noise variance to reckon with over the one that the signals were whitened by, at least 1.
        """
        mode_energy = modes * modes
        samples = self._samples
        noise_energy = energy - float(modes.dot(modes))
        scale = 0
        if self.scales.size > 1:
            left = self._left_coarse.dot(mode_energy).astype(np.float64)
            innovation = (left + noise_energy) / (samples * floor)
            excess = np.maximum(innovation, 1.0)
            deviance = (self._log_det_coarse + samples * (np.log(excess) + innovation / excess)).tolist()
            best = deviance.index(min(deviance))
            scale = best * _STRIDE
            if 0 < best < len(deviance) - 1:
                before, here, after = deviance[best - 1 : best + 2]
                scale += round(_STRIDE * 0.5 * (before - after) / (before - 2.0 * here + after))
        return self._choice(scale, mode_energy, noise_energy, floor, samples, self._constant)

    def judge(self, scale: int, modes: Singles, energy: float, floor: float, lost: Indices, log_det: float) -> Choice:
        """Likelihood of one scale where lost signals were filled in by the others' prediction.

        `log_det` is the logarithm of the determinant of the inverse covariance's part that belongs to the lost ones.
        """
        mode_energy = modes * modes
        noise_energy = energy - float(modes.dot(modes))
        constant = self._constant - 2.0 * float(self._log_noise[lost].sum()) + log_det
        return self._choice(scale, mode_energy, noise_energy, floor, self._samples - lost.size, constant)

    def _choice(
        self, scale: int, mode_energy: Singles, noise_energy: float, floor: float, samples: int, constant: float
    ) -> Choice:
        chi2 = (float(self._left[scale].dot(mode_energy)) + noise_energy) / (samples * floor)
        excess = max(chi2, 1.0)
        deviance = float(self._log_det[scale]) + samples * (math.log(excess) + chi2 / excess)
        deviance += samples * math.log(2.0 * math.pi * floor) + constant
        return Choice(scale, chi2, floor * excess, -0.5 * deviance)
