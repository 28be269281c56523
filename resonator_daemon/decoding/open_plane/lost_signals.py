"""Signals that are missing from a frame: the prediction of them from the others, and what their loss costs.

Filling a lost signal in by its expectation given all others leaves the estimate exactly as if its row had been deleted
from the model. With the inverse covariance K^-1 = 1 - V diag(q L / (q L + 1)) V', the expectation of the lost signals d
is -((K^-1)_dd)^-1 (K^-1 s)_d for s filled by zeros.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from resonator_daemon.arrays import Floats, Indices, Singles
from resonator_daemon.decoding.open_plane.modes import Modes
from resonator_daemon.decoding.open_plane.scale_grid import Choice, ScaleGrid


class LostSignals:
    """One set of lost signals; what each scale needs is computed when it is first asked for.

    Parameters
    ----------
    modes, scale_grid
    lost
        Indices into the flat signals (3 n,).
    """

    def __init__(self, modes: Modes, scale_grid: ScaleGrid, lost: Indices) -> None:
        self._modes = modes
        self._scale_grid = scale_grid
        self._lost = lost
        self._rows = modes.rows(lost)
        self._factors: dict[int, tuple[Floats, bool]] = {}
        self._added_variance: dict[int, Floats] = {}
        self._scale = scale_grid.scales.size // 2  # where the last frame's search ended

    def choose(self, modes: Singles, energy: float, floor: float) -> tuple[Choice, Singles, Floats]:
        """Climb to the scale of largest likelihood; its modes and the predicted signals, whitened.

        `modes` and `energy` are those of the frame with its lost signals set to 0.
        """
        tried: dict[int, tuple[Choice, Singles, Floats]] = {}

        def at(scale: int) -> tuple[Choice, Singles, Floats]:
            if scale not in tried:
                tried[scale] = self._judge(scale, modes, energy, floor)
            return tried[scale]

        step = max(self._scale_grid.scales.size // 16, 1)
        while True:
            around = [
                s
                for s in (self._scale - step, self._scale, self._scale + step)
                if 0 <= s < self._scale_grid.scales.size
            ]
            best = max(around, key=lambda scale: at(scale)[0].log_evidence)
            if best == self._scale:
                if step == 1:
                    return at(best)
                step = max(step // 4, 1)
            self._scale = best

    def added_variance(self, scale: int) -> Floats:
        """Return what the loss adds to the variance of the traction, (3 m,), for noise of the declared variance."""
        if scale not in self._added_variance:
            gain = self._scale_grid.gain[scale]
            spread = np.array([self._modes.traction(gain * row) for row in self._rows.astype(np.float32)], np.float64)
            factor, lower = self._factor(scale)
            reduced = solve_triangular(factor, spread, lower=lower, trans=0 if lower else 1)
            self._added_variance[scale] = np.sum(reduced**2, axis=0)
        return self._added_variance[scale]

    def _judge(self, scale: int, modes: Singles, energy: float, floor: float) -> tuple[Choice, Singles, Floats]:
        factor = self._factor(scale)
        predicted = np.asarray(cho_solve(factor, self._rows @ (self._scale_grid.explained[scale] * modes)), np.float64)
        filled = (modes + predicted @ self._rows).astype(np.float32)
        log_det = 2.0 * float(np.log(np.diag(factor[0])).sum())
        energy += float(predicted @ predicted)
        return self._scale_grid.judge(scale, filled, energy, floor, self._lost, log_det), filled, predicted

    def _factor(self, scale: int) -> tuple[Floats, bool]:
        if scale not in self._factors:
            inverse = np.eye(self._lost.size) - (self._rows * self._scale_grid.explained[scale]) @ self._rows.T
            self._factors[scale] = cho_factor(inverse, lower=True)
        return self._factors[scale]
