"""Choice of the prior's scale, frame by frame, by the likelihood of the signals' eigenmodes."""

import math
from typing import NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Floats, Indices, Singles

_STRIDE = 5  # the likelihood of every fifth scale is computed; a parabola finds the best one between them


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

    def choose_each(self, modes: Singles, energy: Floats, floor: Floats) -> list[Choice]:
        """Choose as `choose` does for each of k frames: modes (r, k), energy and floor (k,)."""
        by_frame, samples = np.ascontiguousarray(modes.T), self._samples
        noise_energy = energy - row_energies(by_frame)
        by_frame = by_frame * by_frame
        scale = np.zeros(energy.size, np.intp)
        if self.scales.size > 1:
            left = (self._left_coarse @ by_frame.T).astype(np.float64)
            innovation = (left + noise_energy) / (samples * floor)
            excess = np.maximum(innovation, 1.0)
            deviance = self._log_det_coarse[:, None] + samples * (np.log(excess) + innovation / excess)
            best = deviance.argmin(axis=0)
            inner = np.flatnonzero((best > 0) & (best < len(deviance) - 1))
            before, here, after = deviance[best[inner] + np.array([[-1], [0], [1]]), inner]
            scale = best * _STRIDE
            scale[inner] += np.rint(_STRIDE * 0.5 * (before - after) / (before - 2.0 * here + after)).astype(np.intp)
        left = (self._left[scale][:, None] @ by_frame[..., None]).ravel().astype(np.float64)
        chi2 = (left + noise_energy) / (samples * floor)
        excess = np.maximum(chi2, 1.0)
        deviance = self._log_det[scale] + samples * (np.log(excess) + chi2 / excess)
        deviance += samples * np.log(2.0 * np.pi * floor) + self._constant
        found = scale, chi2, floor * excess, -0.5 * deviance
        return [Choice(*one) for one in zip(*(values.tolist() for values in found), strict=True)]

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


def row_energies(rows: Singles) -> Floats:
    """Return the sum of squares of each row, (k, n) to (k,), rounded as that of a single one."""
    return np.asarray((rows[:, None, :] @ rows[:, :, None]).ravel(), np.float64)
