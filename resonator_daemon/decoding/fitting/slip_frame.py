"""One frame in units of its noise, and the signals of contacts to first order about some parameters."""

import numpy as np

from resonator_daemon.arrays import Bools, Floats, Singles
from resonator_daemon.decoding.fitting.contact_model import DiscModel
from resonator_daemon.decoding.fitting.slip_signals import PARAMETERS, ROWS, slope_rows
from resonator_daemon.decoding.parameters import SIGNAL_LIMIT


class Whitening:
    """Weights of a frame's signals, which most often are those of the frame before.

    Parameters
    ----------
    model
    known
        Signals that are not lost, (3, n).
    noise_std
        Broadcastable to (3, n). ValueError where it is not above 0.

    Attributes
    ----------
    weights
        1 / noise_std, 0 for lost signals, (3, n).
    factors
        (3 n,), as of `SlipSignals.whiten`.
    """

    def __init__(self, model: DiscModel, known: Bools, noise_std: Floats) -> None:
        if not (noise_std > 0.0).all():
            raise ValueError(f"noise_std reaches {noise_std.min()}, must be above 0")
        self._known, self._noise_std = known, noise_std
        self.weights: Floats = np.where(known, 1.0 / noise_std, 0.0)
        self.factors = model.slip.whiten(self.weights)

    def serves(self, known: Bools, noise_std: Floats) -> bool:
        """Return whether the weights are those of other signals, too."""
        same_noise = noise_std is self._noise_std or np.array_equal(noise_std, self._noise_std)
        return same_noise and np.array_equal(known, self._known)


class Frame:
    """Signals of one frame in units of their noise.

    Parameters
    ----------
    model
    signals
        (3, n); lost ones NaN, infinite or beyond 10.
    noise_std
        Broadcastable to (3, n). ValueError where it is not above 0.
    before
        Whitening of the frame before.

    Attributes
    ----------
    whitening
    target
        (3 n,), lost ones 0.
    count
        Signals that are known.
    """

    def __init__(self, model: DiscModel, signals: Floats, noise_std: Floats, before: Whitening | None) -> None:
        known: Bools = np.abs(signals) <= SIGNAL_LIMIT  # False for NaN
        self.count = int(np.count_nonzero(known))
        same = before is not None and before.serves(known, noise_std)
        self.whitening = before if before is not None and same else Whitening(model, known, noise_std)
        sound = signals if self.count == signals.size else np.where(known, signals, 0.0)
        self.target: Singles = (sound * self.whitening.weights).astype(np.float32).ravel()

    @property
    def energy(self) -> float:
        """Sum of squares in units of the noise."""
        return float(self.target @ self.target)


class Linearisation:
    """Signals of contacts, in units of the noise, to first order about some parameters (7 k,)."""

    def __init__(self, model: DiscModel, parameters: Floats, whitening: Whitening) -> None:
        self.parameters = parameters
        self.whitening = whitening
        contacts = parameters.size // PARAMETERS
        self._rows = rows = np.empty((ROWS * contacts, whitening.factors.size), np.float32)
        scales = [
            model.slip.fill(one, whitening.factors, rows[ROWS * index : ROWS * (index + 1)])
            for index, one in enumerate(parameters.reshape(-1, PARAMETERS))
        ]
        self._value = rows[0] if contacts == 1 else rows[::ROWS].sum(axis=0)
        self._scale = scales[0] if contacts == 1 else np.concatenate(scales)
        self._slopes = slope_rows(contacts)
        # Products of rows with those from the second one on: of a matrix with itself they take three times as long.
        products = (rows @ rows[1:].T)[self._slopes].take(self._slopes - 1, axis=1)
        self.precision: Floats = products * self._scale * self._scale[:, None]

    def left(self, target: Singles) -> tuple[float, Floats]:
        """Chi-square of signals (3 n,) and its gradient (7 k,) at the parameters, without the law of friction."""
        residual = target - self._value
        return float(residual @ residual), (self._rows @ residual)[self._slopes] * self._scale
