"""One frame's linear minimum-mean-square estimate out of its eigenmodes: map, error bars, checks."""

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from resonator_daemon.base.arrays import Bools, Floats, Indices, Singles
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.decoded import (
    CHI2_LIMIT,
    GAIN_FLOOR,
    KNOWN_LIMIT,
    SIGNAL_LIMIT,
    UNEXPLAINED_LIMIT,
    Decoded,
    stated,
)
from resonator_daemon.estimate.surface.open_plane.modes import Choice, Modes, ScaleGrid, Surface

_SIGNIFICANT = 3.0  # standard deviations
_LOST_SETS = 8  # sets of lost signals of which the solution is kept


class LostSignals:
    """One set of lost signals; what each scale needs is computed when it is first asked for.

    Filling a lost signal in by its expectation given all others leaves the estimate exactly as if its row had been
    deleted from the model. With the inverse covariance K^-1 = 1 - V diag(q L / (q L + 1)) V', the expectation of the
    lost signals d is -((K^-1)_dd)^-1 (K^-1 s)_d for s filled by zeros.

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

        count = self._scale_grid.scales.size
        step = max(count // 16, 1)
        while True:
            around = [s for s in (self._scale - step, self._scale, self._scale + step) if 0 <= s < count]
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


class ModeSet(NamedTuple):
    """Eigenmodes that serve frames up to a mean power of the whitened signals, and the likelihood of scales in them."""

    level: float
    modes: Modes
    scale_grid: ScaleGrid


@dataclass(frozen=True)
class Estimate:
    """Estimate from one frame of 3 n signals at m places; the surface is computed as far as it is asked for.

    With a `status` other than "ok" there is no surface, and `reason` states the cause.
    """

    shape: tuple[int, ...]  # of surface arrays, (3, m) or m split in two
    whitened: Singles  # signals over their noise, lost ones 0, (3 n,)
    known: Bools | None  # (3 n,); None where all are
    energy: float  # sum of squares of the whitened signals
    log_evidence: float
    chi2: float
    status: str
    reason: Reason | None
    surface: Surface | None = None

    def decoded(self, displacement: bool) -> Decoded:
        """Return all that the linear decoder gives, the displacement only where asked for."""
        outcome = self.log_evidence, self.chi2, self.status
        if self.surface is None:
            return Decoded.unknown(self.shape, displacement, *outcome, self.reason)
        traction = self.surface.traction.astype(np.float64).reshape(self.shape)
        moved = self.surface.displacement.astype(np.float64).reshape(self.shape) if displacement else None
        std, at_border = self.surface.std().reshape(self.shape), self.surface.reaches_border
        return Decoded(traction, std, moved, at_border, *outcome, *stated(self.reason))


class LinearMap:
    """Estimates of the traction at m places from 3 n signals, frame by frame.

    Parameters
    ----------
    mode_sets
        In the order of their levels; the last one serves whatever is beyond.
    noise_std
        Of each signal, (3 n,).
    gain_std
        Of the signals' gains, relative.
    prior_variance
        Of the traction at scale 1, (3 m,).
    contact_factor
        By which the standard deviation under a contact exceeds the one that a stationary prior gives.
    border
        Which of the m places lie at the border of the sites.
    """

    def __init__(
        self,
        mode_sets: Sequence[ModeSet],
        noise_std: Floats,
        gain_std: float,
        prior_variance: Floats,
        contact_factor: float,
        border: Bools,
    ) -> None:
        self._mode_sets = mode_sets
        self._whiten = (1.0 / noise_std).astype(np.float32)
        self._gain_std = gain_std
        self._gain_floor = (GAIN_FLOOR * gain_std) ** 2 / noise_std.size
        scales = mode_sets[-1].scale_grid.scales
        explained = mode_sets[-1].modes.explained_variance(scales)
        self._std = np.sqrt(np.maximum(scales[:, None] * prior_variance - explained, 0.0))
        self._least_std = self._std[:, -self._std.shape[1] // 3 :].min(axis=1)
        self._contact_factor = contact_factor
        self._border = np.flatnonzero(border)
        self._sound_energy = (SIGNAL_LIMIT / noise_std.max()) ** 2  # below it no signal exceeds the limit
        self._lost: OrderedDict[tuple[float, bytes], LostSignals] = OrderedDict()
        self._inverse_diagonal: dict[tuple[float, int], Floats] = {}

    def estimate(self, signals: Floats, shape: tuple[int, ...]) -> Estimate:
        """Estimate the surface from one frame (3 n,), in arrays of `shape`, (3, m) or m split in two."""
        whitened, known, energy = self._prepare(signals)
        frame = shape, whitened, known, energy
        share = 1.0 if known is None else float(known.mean())
        if share < KNOWN_LIMIT:
            reason = f"{share:.0%} of the signals known (finite, within {SIGNAL_LIMIT}), needs {KNOWN_LIMIT:.0%}"
            return Estimate(*frame, np.nan, np.nan, "no_signal", Reason(ReasonCode.SIGNALS_MISSING, reason))
        mode_set, choice, modes, _ = self._choose(whitened, known, energy)
        std, lost = self._std[choice.scale], None
        if known is not None:
            added_variance = self._lost_signals(mode_set, known).added_variance(choice.scale)
            std = np.sqrt(std**2 + added_variance)
            lost = Reason(
                ReasonCode.SIGNALS_LOST, f"{known.size - known.sum()} of {known.size} signals lost and filled in"
            )

        if choice.chi2 > CHI2_LIMIT:
            left = choice.chi2 * self._floor(energy) * whitened.size / energy
            if left > UNEXPLAINED_LIMIT:
                text = f"chi2 {choice.chi2:.3g} exceeds {CHI2_LIMIT:.0f} and {left:.0%} of the energy are unexplained"
                unexplained = Reason(ReasonCode.SIGNALS_UNEXPLAINED, text)
                return Estimate(*frame, choice.log_evidence, choice.chi2, "rejected", unexplained)

        excess = math.sqrt(choice.excess)
        surface = Surface(
            mode_set.modes,
            mode_set.scale_grid.gain[choice.scale] * modes,
            std.reshape(3, -1),
            excess,
            self._contact_factor,
            _SIGNIFICANT * excess * float(self._least_std[choice.scale]),
            self._border,
        )
        return Estimate(*frame, choice.log_evidence, choice.chi2, "ok", lost, surface)

    def scores_and_predictions(self, signals: Floats) -> tuple[Floats, Floats]:
        """Return the leave-one-out residual of each signal, and its prediction from all others, (3 n,).

        Both are divided by the standard deviation of the residual, gain errors included.
        """
        whitened, known, energy = self._prepare(signals)
        if known is not None and known.mean() < KNOWN_LIMIT:
            return np.full(whitened.size, np.nan), np.full(whitened.size, np.nan)
        mode_set, choice, modes, predicted = self._choose(whitened, known, energy)
        if known is not None:
            whitened[~known] = predicted
        explained = mode_set.scale_grid.explained[choice.scale]
        key = mode_set.level, choice.scale
        if key not in self._inverse_diagonal:
            self._inverse_diagonal[key] = 1.0 - mode_set.modes.explained_signals(explained)
        left = whitened - mode_set.modes.signals((explained * modes).astype(np.float32))
        off = left / self._inverse_diagonal[key]
        std = np.sqrt(1.0 / self._inverse_diagonal[key] + (self._gain_std * (whitened - off)) ** 2)
        scores, expected = off / std, (whitened - off) / std
        if known is not None:
            scores[~known] = np.nan
        return scores, expected

    def _prepare(self, signals: Floats) -> tuple[Singles, Bools | None, float]:
        """Whitened signals, lost ones 0; which are known, None where all are; their sum of squares."""
        whitened = signals.astype(np.float32) * self._whiten
        energy = float(whitened.dot(whitened))
        if energy <= self._sound_energy:
            return whitened, None, energy
        known = np.abs(signals) <= SIGNAL_LIMIT  # False for NaN
        if known.all():
            return whitened, None, energy
        whitened[~known] = 0.0
        return whitened, known, float(whitened @ whitened)

    def _choose(
        self, whitened: Singles, known: Bools | None, energy: float
    ) -> tuple[ModeSet, Choice, Singles, Floats | None]:
        """Return the mode set that serves a frame, its scale, its modes, and the lost signals predicted, whitened."""
        power = energy / self._whiten.size
        mode_set = next((mode_set for mode_set in self._mode_sets if power <= mode_set.level), self._mode_sets[-1])
        modes, floor = mode_set.modes.project(whitened), self._floor(energy)
        if known is None:
            return mode_set, mode_set.scale_grid.choose(modes, energy, floor), modes, None
        return mode_set, *self._lost_signals(mode_set, known).choose(modes, energy, floor)

    def _floor(self, energy: float) -> float:
        return 1.0 + self._gain_floor * energy

    def _lost_signals(self, mode_set: ModeSet, known: Bools) -> LostSignals:
        key = mode_set.level, known.tobytes()
        if key not in self._lost:
            self._lost[key] = LostSignals(mode_set.modes, mode_set.scale_grid, np.flatnonzero(~known))
            if len(self._lost) > _LOST_SETS:
                self._lost.popitem(last=False)
        self._lost.move_to_end(key)
        return self._lost[key]
