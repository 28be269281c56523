"""Tones of a channelised counter to the sites' signals, and whether a frame of them is that of an untouched plate."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.measurement.force import FloatArray

SIGNALS: Final = 3  # p_n, eps_xz, eps_yz
TONES_MIN: Final = 16  # fewer do not tell a common mode from a touch
UNTOUCHED_SIGMAS: Final = 6.0
NOISE_TOLERANCE: Final = 1.1  # stated variances come in steps of an eighth of an octave in sigma: 9 % either way
RESIDUAL_CLIP: Final = 25.0  # so that a few bad tones do not pass for a touch


class Shifts(NamedTuple):
    """Relative shift 1 - f0/f of every tone on every channel, (4, t), and its inverse variance, 0 where not known."""

    shift: FloatArray
    weight: FloatArray


class ToneArray:
    """A plate's tones, each one signal of one site, as four corners hear them."""

    def __init__(
        self,
        f0_hz: FloatArray,
        sensitivity: FloatArray,
        oscillator_hz: FloatArray,
        site_index: NDArray[np.integer],
        signal_index: NDArray[np.integer],
        youngs_modulus_pascal: float,
    ) -> None:
        """Take the plate's arrays by tone; sites count from 0 to the largest in `site_index`.

        Parameters
        ----------
        f0_hz, sensitivity
            (t, 4); sensitivity is signed, in 1/Pa for signal 0 (p_n) and 1/strain for signals 1 and 2.
        oscillator_hz
            (t,), what the board counts each tone against.
        site_index, signal_index
            (t,), no pair twice.
        """
        tones = len(f0_hz)
        shapes = (sensitivity.shape, oscillator_hz.shape, site_index.shape, signal_index.shape)
        if tones == 0 or f0_hz.shape != (tones, 4) or shapes != ((tones, 4), (tones,), (tones,), (tones,)):
            raise ValueError(
                f"f0_hz {f0_hz.shape} must be (t, 4) with t > 0, and with it (t, 4), (t,), (t,), (t,): {shapes}"
            )
        if not (np.isfinite(sensitivity).all() and (sensitivity != 0).any(axis=1).all()):
            raise ValueError("sensitivity must be finite, and not 0 on every channel of a tone")
        for name, hertz in (("f0_hz", f0_hz), ("oscillator_hz", oscillator_hz)):
            if not (np.isfinite(hertz).all() and (hertz > 0).all()):
                raise ValueError(f"{name} must be finite and above 0")
        if signal_index.min() < 0 or signal_index.max() >= SIGNALS or site_index.min() < 0:
            raise ValueError(f"signal_index must lie in 0..{SIGNALS - 1} and site_index at 0 or above")
        if not (math.isfinite(youngs_modulus_pascal) and youngs_modulus_pascal > 0):
            raise ValueError(f"youngs_modulus_pascal {youngs_modulus_pascal} must be finite and above 0")
        sites = int(site_index.max()) + 1
        self._slot = signal_index * sites + site_index  # into (3, sites), flattened
        if len(np.unique(self._slot)) != tones:
            raise ValueError("two tones carry the same signal of one site")
        self.shape = (SIGNALS, sites)
        self.tones = tones
        self._oscillator_hz = oscillator_hz
        self._detuning_hz = oscillator_hz - f0_hz.T
        self._f0_squared = np.ascontiguousarray(f0_hz.T) ** 2
        # Per unit of the dimensionless triple [3 p_n / (2 E), eps_xz, eps_yz].
        unit = np.where(signal_index == 0, 2.0 * youngs_modulus_pascal / 3.0, 1.0)
        self._sensitivity = np.ascontiguousarray(sensitivity.T) * unit
        self._sensitivity_squared = self._sensitivity**2

    def shifts(self, offset_hz: FloatArray, sigma_hz: FloatArray, known: NDArray[np.bool_]) -> Shifts:
        """Shift of each tone from its offset against the board's oscillator; all (4, t)."""
        shift = (offset_hz + self._detuning_hz) / (offset_hz + self._oscillator_hz)
        return Shifts(shift, np.where(known, self._f0_squared / sigma_hz**2, 0.0))

    def untouched_common_mode(self, shifts: Shifts) -> float | None:
        """Relative frequency error g common to all tones, or None where the plate may be touched.

        g comes from the median over the tones. Untouched means that what is left of each tone, corners combined, is no
        more than its noise: mean of the squares, each clipped, within six standard deviations of a chi-square's. A
        touch that moves most tones alike and the others not at all is told; one that moves all tones alike is not.
        """
        weight = shifts.weight.sum(axis=0)
        heard = np.flatnonzero(weight)
        if len(heard) < TONES_MIN:
            return None
        weight = weight[heard]
        shift = (shifts.weight * shifts.shift).sum(axis=0)[heard] / weight
        middle = float(np.median(shift))
        spread = float(np.minimum(weight * (shift - middle) ** 2, RESIDUAL_CLIP).mean())
        if spread > NOISE_TOLERANCE + UNTOUCHED_SIGMAS * math.sqrt(2.0 / len(heard)):
            return None
        return middle / (1.0 - middle)

    def signals(self, shifts: Shifts, common_mode: float) -> tuple[FloatArray, FloatArray]:
        """Signals [3 p_n / (2 E), eps_xz, eps_yz] and their standard deviations, both (3, sites).

        Each corner's shift, freed of the common mode and divided by its signed sensitivity, weighs by its inverse
        variance. NaN where no corner is known or the plate has no such tone.
        """
        weighted = shifts.weight * self._sensitivity
        # f over (1 + g) shifts by (1 + g) y - g.
        total = (1.0 + common_mode) * (weighted * shifts.shift).sum(axis=0) - common_mode * weighted.sum(axis=0)
        information = (shifts.weight * self._sensitivity_squared).sum(axis=0)
        heard = np.flatnonzero(information)
        signals, noise_std = np.full(self.shape, np.nan), np.full(self.shape, np.nan)
        signals.ravel()[self._slot[heard]] = total[heard] / information[heard]
        noise_std.ravel()[self._slot[heard]] = 1.0 / np.sqrt(information[heard])
        return signals, noise_std
