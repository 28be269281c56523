"""What a channelised counter hears in a tenth of a second: every site at once, and which of them is loaded."""

import math
from collections import deque
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.arrays import Floats
from resonator_daemon.calibration.hearing import NOTHING, PILOT, READING_S, Heard
from resonator_daemon.calibration.refusal import CalibrationRefusedError
from resonator_daemon.calibration.site_codes import site_codes
from resonator_daemon.forces.force_tones import SIGMA_HZ
from resonator_daemon.plate import Plate
from resonator_daemon.tones.frequency_estimators import oscillator_std
from resonator_daemon.tones.tone_merging import merge_tones

REST_READINGS: Final = 10  # whose mean is f0
TOUCH_SHARE: Final = 0.01  # of the plate's largest force: below it is what an earlier touch has left
MOVED_SHARE: Final = 5e-4  # likewise: a load comes or goes
PRESSED_SHARE: Final = 0.05  # likewise: that far off, f0 of a plate that was calibrated before is not its own
LEAST_SHARE: Final = 0.25  # of the sites
REST_SHARE: Final = 0.003  # by which an untouched reading moves what is taken for rest, as warmth moves it


class _Frame(NamedTuple):
    phase_turn32: NDArray[np.integer]
    offset_hz16: NDArray[np.integer]
    sigma_hz: Floats
    known: NDArray[np.bool_]


class CombEar:
    """Frames of a channelised plate to readings, against its own untouched first second.

    In the place of the pilot is what moves the middle one of the sites from one untouched reading to the next, of those
    that felt least of a touch in between: hysteresis and creep leave something of it behind on the others.
    """

    def __init__(self, plate: Plate, oscillator_hz: Floats) -> None:
        """`oscillator_hz` (tones,) is what the board counts each tone against."""
        self._gate_s = 1.0 / plate.counter.frame_rate_hz
        self._frames: deque[_Frame] = deque(maxlen=max(1, round(READING_S / self._gate_s)))
        self._codes = site_codes(plate)
        self._oscillator_hz = oscillator_hz[self._codes.tone]
        self._site_ids = plate.site_ids.tolist()
        self._touch_newton = TOUCH_SHARE * plate.force_max_newton
        self._moved_newton = MOVED_SHARE * plate.force_max_newton
        self._pressed_newton = PRESSED_SHARE * plate.force_max_newton if plate.calibration.id is not None else math.inf
        self._first: int | None = None
        self._last: int | None = None
        self._resting: list[Floats] = []  # (m, 4), hertz
        self._f0_hz: Floats | None = None
        self._rest = np.zeros(self._codes.f0_hz.shape)  # shift while untouched, with the common mode
        self._before = self._rest  # shift of the reading before
        self._peak_newton = np.zeros(len(self._site_ids))  # on each site since that anchor
        self._anchor = self._untouched = (self._rest, np.zeros(CHANNEL_COUNT))  # shift and common mode of readings

    @property
    def f0_hz(self) -> Floats:
        """Frequencies (m, 4) of the untouched plate, by the board's clock."""
        if self._f0_hz is None:
            raise ValueError("f0_hz before the untouched plate was heard")
        return self._f0_hz

    def push(
        self,
        index: int,
        phase_turn32: NDArray[np.integer],
        offset_hz16: NDArray[np.integer],
        sigma_code: NDArray[np.uint8],
        known: NDArray[np.bool_],
    ) -> Heard | None:
        """Take one frame, arrays (4, tones) in the wire's units; gives a reading every tenth of a second.

        Raises
        ------
        CalibrationRefusedError
            Touched within the first second.
        """
        self._first = index if self._first is None else self._first
        if self._last is not None and index != self._last + 1:
            self._frames.clear()
        self._last = index
        tone = self._codes.tone
        sigma_hz = SIGMA_HZ[sigma_code[:, tone]]
        self._frames.append(_Frame(phase_turn32[:, tone], offset_hz16[:, tone], sigma_hz, known[:, tone]))
        count = self._frames.maxlen or 1
        if (index - self._first + 1) % count:
            return None
        return self._read((index - self._first + 1 - 0.5 * count) * self._gate_s)

    def _read(self, time_s: float) -> Heard | None:
        phase, offset, sigma, known = (np.array(part) for part in zip(*self._frames, strict=True))
        merged = merge_tones(phase, offset, sigma, known, self._gate_s)
        heard_hz = self._oscillator_hz[:, None] + merged.offset_hz.T  # (m, 4)
        complete = len(self._frames) == self._frames.maxlen
        faults = tuple(self._fault(channel) if complete else "frames are missing" for channel in heard_hz.T)
        if any(faults):
            return _nothing(time_s, faults)
        if self._f0_hz is None:
            self._begin(heard_hz)
            return None
        return self._compare(time_s, self._f0_hz, heard_hz, merged.sigma_hz.T / heard_hz)

    def _fault(self, heard_hz: Floats) -> str:
        silent = [str(self._site_ids[site]) for site in np.flatnonzero(~np.isfinite(heard_hz))]
        return f"without sites {', '.join(silent)}" if silent else ""

    def _begin(self, heard_hz: Floats) -> None:
        """Take one reading of the untouched plate."""
        self._resting.append(heard_hz)
        shift = np.array(self._resting) / self._resting[0] - 1.0
        moved = self._force(shift - shift.mean(axis=1, keepdims=True))
        self._refuse_touch(np.ptp(moved, axis=0), self._touch_newton)
        if len(self._resting) == REST_READINGS:
            self._f0_hz = np.mean(self._resting, axis=0)
            off = self._f0_hz / self._codes.f0_hz - 1.0
            self._refuse_touch(np.abs(self._force(off - np.median(off, axis=0))), self._pressed_newton)

    def _refuse_touch(self, force_newton: Floats, limit_newton: float) -> None:
        site = int(force_newton.argmax())
        if force_newton[site] > limit_newton:
            raise CalibrationRefusedError(
                f"baseline: site {self._site_ids[site]} is touched ({force_newton[site]:.2g} N by the plate file, at "
                f"most {limit_newton:.2g} N); take everything off the plate and begin again"
            )

    def _force(self, shift: Floats) -> Floats:
        """Force by the plate file's sensitivities, mean over the channels; shift (..., m, 4)."""
        force: Floats = (shift / self._codes.sensitivity).mean(axis=-1)
        return force

    def _compare(self, time_s: float, f0_hz: Floats, heard_hz: Floats, std: Floats) -> Heard:
        shift = 1.0 - f0_hz / heard_hz
        force = self._force(shift - self._rest)
        site = int(force.argmax())
        touched = force[site] > self._touch_newton
        lowest = int(force.argmin())
        if not touched and force[lowest] < -self._touch_newton:
            raise CalibrationRefusedError(
                f"site {self._site_ids[lowest]} reads {force[lowest]:.2g} N against its baseline: it was touched then, "
                "or the plate file has its sensitivity with the wrong sign"
            )
        moved = np.abs(self._force(shift - self._before)).max() > self._moved_newton
        self._before = shift
        if moved and not touched:
            return _nothing(time_s, ("a load moves",) * CHANNEL_COUNT)
        common = np.full(CHANNEL_COUNT, math.nan)
        if not touched:
            self._rest += REST_SHARE * (shift - self._rest)
            common = self._common(shift)
        else:
            self._anchor = self._untouched  # until a reading comes after the touch
            self._peak_newton = np.maximum(self._peak_newton, np.abs(force))
        return Heard(
            time_s,
            (site if touched else PILOT,) * CHANNEL_COUNT,
            common,
            shift[site],
            std[site],
            oscillator_std(READING_S),
            ("",) * CHANNEL_COUNT,
            shift,
        )

    def _common(self, shift: Floats) -> Floats:
        """Return what all sites of an untouched reading have moved by, (4,)."""
        before, common = self._anchor
        least = self._peak_newton <= np.quantile(self._peak_newton, LEAST_SHARE)
        common = common + np.median((shift - before)[least], axis=0)
        if self._anchor is self._untouched:
            self._anchor = (shift, common)
            self._peak_newton = np.zeros(len(shift))
        self._untouched = (shift, common)
        return common


def _nothing(time_s: float, faults: tuple[str, ...]) -> Heard:
    nothing = np.full(CHANNEL_COUNT, math.nan)
    tones = tuple(NOTHING if fault else PILOT for fault in faults)
    return Heard(time_s, tones, nothing, nothing, nothing, math.nan, faults)
