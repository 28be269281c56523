"""Lost signals of a grid, replaced by what a spectral model predicts from the others."""

import numpy as np

from resonator_daemon.arrays import Bools, Floats
from resonator_daemon.decoding.fourier.extension import ExtendedTransform
from resonator_daemon.decoding.fourier.wiener import SpectralWiener

_ROUNDS = 20  # most rounds of the model's own prediction ...
_TOLERANCE = 0.3  # ... which end when it changes by less than this share of the noise


class Imputation:
    """Imputation of lost signals in frames (3, ny, nx).

    Parameters
    ----------
    shape
        (ny, nx) of the array.
    transform, wiener
        The model.
    noise_variance
        Mean over the channels.
    depth_pitches
        Depth of the sites over their pitch.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        transform: ExtendedTransform,
        wiener: SpectralWiener,
        noise_variance: float,
        depth_pitches: float,
    ) -> None:
        self._shape = shape
        self._transform = transform
        self._wiener = wiener
        self._noise_variance = noise_variance
        self._neighbours_y, self._neighbours_x = (_kernel(n, 0.5) for n in shape)
        self._blur_y, self._blur_x = (_kernel(n, 0.5 * max(depth_pitches, 1.0)) for n in shape)

    def fill(self, frame: Floats, known: Bools) -> tuple[Floats, bool]:
        """Replace lost signals by the model's prediction from the others; False where that has not settled.

        A mean of the neighbours, then expectation and maximisation in turn, with Nesterov's momentum.
        """
        total = self._neighbours_y @ np.where(known, frame, 0.0) @ self._neighbours_x
        filled = predicted = np.where(known, frame, total / (self._neighbours_y @ known @ self._neighbours_x))
        limit = _TOLERANCE**2 * self._noise_variance * (known.size - known.sum())
        for n in range(_ROUNDS):
            fit = self._wiener.fit(self._transform.to_spectrum(filled[None]), float(known.mean()))
            change = np.where(known, 0.0, self._transform.to_space(self._wiener.signals(fit))[0] - predicted)
            predicted = predicted + change
            filled = predicted + n / (n + 3.0) * change
            if np.sum(change**2) < limit:
                return predicted, True
        return predicted, False

    def density(self, known: Bools) -> Floats:
        """Share of known signals around each site, of the channel that has lost most there."""
        ones = np.ones(self._shape)
        shares = (self._blur_y @ known @ self._blur_x) / (self._blur_y @ ones @ self._blur_x)
        return np.asarray(shares.min(axis=0), np.float64)


def _kernel(count: int, width: float) -> Floats:
    """Return weights (count, count) that fall with the distance of two samples, a few times faster beyond `width`."""
    distance = np.subtract.outer(np.arange(count), np.arange(count))
    return np.asarray(1.0 / (1.0 + (distance / width) ** 2) ** 2, np.float64)
