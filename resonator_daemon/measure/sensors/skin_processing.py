"""Frames of a channelised counter under a skin: tones to signals, freed of what they have in common."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.forces.baseline import CommonMode
from resonator_daemon.estimate.forces.readings import SensorStatus, SkinReading
from resonator_daemon.measure.sensors.skin_signals import TONES_MIN, ToneArray
from resonator_daemon.measure.sensors.usual_reasons import COMMON_MODE_PENDING, NO_TONE

BASELINE_READINGS: Final = 20  # untouched readings before the common mode counts as known
# Untouched readings in a row after which the common mode is that of any earlier beginning, to the last bit: with the
# noise below and its walk, each reading leaves 0.4 of what an earlier estimate differed by.
REST_READINGS: Final = 40
COMMON_MODE_NOISE: Final = 1e-9  # of one frame, relative: the median of a thousand tones
_PRESSED: Final = Reason(ReasonCode.PRESSED_AT_START, "touched before the common mode was estimated")


class SkinProcessing:
    """Offsets of many tones on four channels to the signals of the sites under a skin."""

    def __init__(
        self,
        f0_hz: Floats,
        sensitivity: Floats,
        oscillator_hz: Floats,
        site_index: NDArray[np.integer],
        signal_index: NDArray[np.integer],
        *,
        youngs_modulus_pascal: float,
        gate_s: float,
    ) -> None:
        """Initialise with a plate's tones as `ToneArray` does, (t, 4) and (t,), and the board's oscillators (t,)."""
        self._tones = ToneArray(f0_hz, sensitivity, oscillator_hz, site_index, signal_index, youngs_modulus_pascal)
        self._offset_hz = np.empty((4, len(f0_hz)))
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
        self,
        sequence: int,
        board_ticks: int,
        offset_hz16: NDArray[np.integer],
        variance_hz2: Floats,
    ) -> SkinReading:
        """Process one frame, each array (4, t): offsets in 2^-16 Hz, and their variance, infinite where not known."""
        shape = (4, self._tones.tones)
        if offset_hz16.shape != shape or variance_hz2.shape != shape:
            raise ValueError(f"shapes {offset_hz16.shape} and {variance_hz2.shape} must be {shape}")
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
