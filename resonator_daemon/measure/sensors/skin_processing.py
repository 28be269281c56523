"""Frames of a channelised counter under a skin: tones to signals, freed of what they have in common."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.forces.baseline import CommonMode
from resonator_daemon.estimate.forces.readings import SensorStatus, SkinReading
from resonator_daemon.measure.sensors.output import COMMON_MODE_PENDING, NO_TONE

SIGNALS: Final = 3  # p_n, eps_xz, eps_yz
TONES_MIN: Final = 16  # fewer do not distinguish a common mode from a touch
UNTOUCHED_SIGMAS: Final = 6.0
NOISE_TOLERANCE: Final = 1.1  # stated variances come in steps of an eighth of an octave in sigma: 9 % either way
RESIDUAL_CLIP: Final = 25.0  # so that a few bad tones do not pass for a touch


class Shifts(NamedTuple):
    """Relative shift 1 - f0/f of every tone on every channel, (4, t), and its inverse variance, 0 where not known.

    `information` (t,) is the inverse variance of each tone, its corners combined. The next frame overwrites all three.
    """

    shift: Floats
    weight: Floats
    information: Floats


class ToneArray:
    """A plate's tones, each one signal of one site, as counted at four corners."""

    def __init__(
        self,
        f0_hz: Floats,
        sensitivity: Floats,
        oscillator_hz: Floats,
        site_index: NDArray[np.integer],
        signal_index: NDArray[np.integer],
        youngs_modulus_pascal: float,
    ) -> None:
        """Initialise with the plate's arrays by tone; sites count from 0 to the largest in `site_index`.

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
        sites = int(site_index.max()) + 1
        self._slot = signal_index * sites + site_index  # into (3, sites), flattened
        self.shape = (SIGNALS, sites)
        self.tones = tones
        self._oscillator_hz = oscillator_hz
        self._detuning_hz = oscillator_hz - f0_hz.T
        self._f0_squared = np.ascontiguousarray(f0_hz.T) ** 2
        # Per unit of the dimensionless triple [3 p_n / (2 E), eps_xz, eps_yz].
        unit = np.where(signal_index == 0, 2.0 * youngs_modulus_pascal / 3.0, 1.0)
        self._sensitivity = np.ascontiguousarray(sensitivity.T) * unit
        self._sensitivity_squared = self._sensitivity**2
        # The same memory for every frame: fresh arrays of 100 kB each would have to come into the cache.
        self._shift, self._weight, self._product = (np.empty((4, tones)) for _ in range(3))

    def shifts(self, offset_hz: Floats, variance_hz2: Floats) -> Shifts:
        """Shift of each tone from its offset against the board's oscillator, and that offset's variance; all (4, t).

        The variance of an offset that is not known is infinite; the offset itself is finite in any case.
        """
        shift, weight, frequency_hz = self._shift, self._weight, self._product
        np.add(offset_hz, self._detuning_hz, out=shift)
        np.add(offset_hz, self._oscillator_hz, out=frequency_hz)
        np.divide(shift, frequency_hz, out=shift)
        np.divide(self._f0_squared, variance_hz2, out=weight)
        return Shifts(shift, weight, weight.sum(axis=0))

    def untouched_common_mode(self, shifts: Shifts) -> float | None:
        """Relative frequency error g common to all tones, or None where the plate may be touched.

        g comes from the median over the tones. Untouched means that what is left of each tone, corners combined, is no
        more than its noise: mean of the squares, each clipped, within six standard deviations of a chi-square's. A
        touch that moves most tones alike and the others not at all is detected; one that moves all tones alike is not.
        """
        weight = shifts.information
        shift = np.multiply(shifts.weight, shifts.shift, out=self._product).sum(axis=0)
        if not weight.all():
            present = np.flatnonzero(weight)
            weight, shift = weight[present], shift[present]
        tones = len(weight)
        if tones < TONES_MIN:
            return None
        shift /= weight
        middle = _median(shift)
        shift -= middle
        shift *= shift
        shift *= weight
        spread = float(np.minimum(shift, RESIDUAL_CLIP, out=shift).mean())
        if spread > NOISE_TOLERANCE + UNTOUCHED_SIGMAS * math.sqrt(2.0 / tones):
            return None
        return middle / (1.0 - middle)

    def signals(self, shifts: Shifts, common_mode: float) -> tuple[Floats, Floats]:
        """Signals [3 p_n / (2 E), eps_xz, eps_yz] and their standard deviations, both (3, sites).

        Each corner's shift, freed of the common mode and divided by its signed sensitivity, weighs by its inverse
        variance. NaN where no corner is known or the plate has no such tone.
        """
        product = self._product
        common = np.multiply(shifts.weight, self._sensitivity, out=product).sum(axis=0)
        # f over (1 + g) shifts by (1 + g) y - g.
        total = (1.0 + common_mode) * np.multiply(product, shifts.shift, out=product).sum(axis=0) - common_mode * common
        information = np.multiply(shifts.weight, self._sensitivity_squared, out=product).sum(axis=0)
        slot = self._slot
        if not information.all():
            present = np.flatnonzero(information)
            slot, total, information = slot[present], total[present], information[present]
        signals, noise_std = np.full(self.shape, np.nan), np.full(self.shape, np.nan)
        signals.ravel()[slot] = total / information
        noise_std.ravel()[slot] = 1.0 / np.sqrt(information)
        return signals, noise_std


def _median(values: Floats) -> float:
    """Return the median of finite values."""
    upper = len(values) // 2
    lower = upper if len(values) % 2 else upper - 1
    ordered = np.partition(values, (lower, upper))
    return float(ordered[lower] + ordered[upper]) / 2.0


BASELINE_READINGS: Final = 20  # untouched readings before the common mode counts as known
# Untouched readings in a row after which the common mode is that of any earlier beginning, to the last bit: with the
# noise below and its walk, each reading leaves 0.4 of what an earlier estimate differed by.
REST_READINGS: Final = 40
COMMON_MODE_NOISE: Final = 1e-9  # of one frame, relative: the median of a thousand tones
_PRESSED: Final = Reason(ReasonCode.PRESSED_AT_START, "touched before the common mode was estimated")


class SkinProcessing:
    """Offsets of many tones on four channels to the signals of the sites under a skin."""

    def __init__(self, tones: ToneArray, *, gate_s: float) -> None:
        self._tones = tones
        self._offset_hz = np.empty((4, tones.tones))
        self._gate_s = gate_s
        self._common_mode = CommonMode(1, needed=BASELINE_READINGS, reading_std=COMMON_MODE_NOISE)
        self._untouched_readings = 0  # in a row

    def restart(self) -> None:
        """Discard the baseline: the board has booted or is configured again."""
        self._common_mode.reset()
        self._untouched_readings = 0

    @property
    def at_rest(self) -> bool:
        """Whether readings to come are those of any earlier or later beginning."""
        return self._untouched_readings >= REST_READINGS

    def push(
        self, sequence: int, board_ticks: int, offset_hz16: NDArray[np.integer], variance_hz2: Floats
    ) -> SkinReading:
        """Process one frame, each array (4, t): offsets in 2^-16 Hz, and their variance, infinite where not known."""
        np.multiply(offset_hz16, 2.0**-16, out=self._offset_hz)
        shifts = self._tones.shifts(self._offset_hz, variance_hz2)
        untouched = self._tones.untouched_common_mode(shifts)
        self._untouched_readings = 0 if untouched is None else self._untouched_readings + 1
        self._common_mode.update([math.nan if untouched is None else untouched], self._gate_s)
        (common_mode,) = self._common_mode.value
        # Without a common mode every signal is NaN, like the common mode itself.
        signals, noise_std = self._tones.signals(shifts, common_mode)
        status, reason = self._status(untouched is not None, int(np.count_nonzero(shifts.information)))
        return SkinReading(
            sequence, board_ticks, self._gate_s, status, reason, signals, noise_std, common_mode, self.at_rest
        )

    def _status(self, untouched: bool, detected: int) -> tuple[SensorStatus, Reason | None]:
        if detected == 0:
            return "no_signal", NO_TONE
        if self._common_mode.known:
            return "ok", None
        if untouched:
            return "settling", COMMON_MODE_PENDING
        if detected < TONES_MIN:
            text = f"{detected} tones known, at least {TONES_MIN} needed to estimate the common mode"
            return "no_signal", Reason(ReasonCode.TOO_FEW_TONES, text)
        return "pressed_at_start", _PRESSED
