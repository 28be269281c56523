"""Readings of a board whose plate is loaded site after site, of a counter of one tone for each corner or of all."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import ConfigurationError, ExitCode, IncompatibleBoardError, UserError
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from resonator_daemon.base.reasons import Condition
from resonator_daemon.board.session.frames import (
    BoardOnline,
    BoardRefused,
    ChannelisedFrame,
    LinkChange,
    SingleToneFrame,
)
from resonator_daemon.board.session.link_state import OPENING
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std
from resonator_daemon.estimate.tones.tone_detector import PILOT_TOLERANCE, READING_S, ToneReading
from resonator_daemon.measure.pipeline.tone_capture import ToneCapture
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError


class SiteCodes(NamedTuple):
    """Codes of m force sites in the plate file, in the order of its site_ids."""

    tone: NDArray[np.intp]  # (m,), its place among the plate's tones
    f0_hz: Floats  # (m, 4)
    sensitivity: Floats  # (m, 4), 1/N
    temperature_coefficients: Floats  # (m, 3), NaN where the file does not give them


def site_codes(plate: Plate) -> SiteCodes:
    """Return the codes of a plate with force sites."""
    tones = plate.tones
    of_force = np.flatnonzero(tones.signal_index == plate.signals.index(FORCE_SIGNAL))
    tone = of_force[np.argsort(tones.site_index[of_force])]
    return SiteCodes(tone, tones.f0_hz[tone], tones.sensitivity[tone], tones.temperature_coefficients[tone])


PILOT: Final = -1
NOTHING: Final = -2  # no tone, or none for the whole reading


@dataclass(frozen=True)
class LoadReading:
    """One reading: relative shifts by channel (4,), NaN where they do not apply.

    `tone` and `shift` are of the loaded site where all sites are counted; `pilot_shift` is then that of their mean.
    """

    time_s: float  # at its middle, since the first frame
    tone: tuple[int, ...]  # by channel: a site's index, PILOT or NOTHING
    pilot_shift: Floats  # f / f_pilot - 1
    shift: Floats  # 1 - f0 / f of the site counted, the common mode still in it
    std: Floats  # relative, of the counter
    oscillator_std: float  # relative, common to the channels
    faults: tuple[str | None, ...]  # by channel: why there is no tone
    site_shift: Floats | None = None  # (sites, 4), where all sites are counted

    @property
    def untouched(self) -> bool:
        return all(tone == PILOT for tone in self.tone)

    @property
    def touched(self) -> int | None:
        """Index of a site that at least two channels count; the one that most count."""
        sites = [tone for tone in self.tone if tone >= 0]
        best = max(set(sites), key=sites.count, default=None)
        return best if best is not None and sites.count(best) > 1 else None


class CapturedLoads:
    """Readings of a counter that captures the pilot, or a loaded site in its place."""

    untouched_hz = None

    def __init__(self, plate: Plate) -> None:
        codes = site_codes(plate)
        self._f0_hz, self._sensitivity = codes.f0_hz, codes.sensitivity
        self._force_max_newton = plate.force_max_newton
        self._pilot_hz = plate.pilot_hz

    def read(self, reading: ToneReading) -> LoadReading:
        tone = [NOTHING] * CHANNEL_COUNT
        pilot_shift, shift = np.full((2, CHANNEL_COUNT), math.nan)
        (hertz,), (std,) = reading.frequency_hz, reading.std
        for channel in np.flatnonzero(np.isfinite(hertz)).tolist():
            off = hertz[channel] / self._pilot_hz - 1
            if abs(off) < PILOT_TOLERANCE:
                tone[channel], pilot_shift[channel] = PILOT, off
            else:
                tone[channel] = site = self._nearest(hertz[channel], channel)
                shift[channel] = 1 - self._f0_hz[site, channel] / hertz[channel]
        return LoadReading(reading.time_s, tuple(tone), pilot_shift, shift, std, reading.oscillator_std, reading.faults)

    def _nearest(self, hertz: float, channel: int) -> int:
        """Return the site whose tone, under any force in its range, comes nearest."""
        shift = 1 - self._f0_hz[:, channel] / hertz
        sensitivity = self._sensitivity[:, channel]
        force = np.clip(shift / sensitivity, 0.0, self._force_max_newton)
        return int(np.abs(shift - sensitivity * force).argmin())


REST_READINGS: Final = 10  # whose mean is f0
TOUCH_SHARE: Final = 0.01  # of the plate's largest force: below it is what an earlier touch has left
MOVED_SHARE: Final = 5e-4  # likewise: a load comes or goes
PRESSED_SHARE: Final = 0.05  # likewise: that far off, f0 of a plate that was calibrated before is not its own
LEAST_SHARE: Final = 0.25  # of the sites
REST_SHARE: Final = 0.003  # by which an untouched reading moves what is taken for rest, as warmth moves it


class MultitoneLoads:
    """Readings of a plate against its own untouched first second.

    In the place of the pilot is what moves the middle one of the sites from one untouched reading to the next, of those
    that felt least of a touch in between: hysteresis and creep leave something of it behind on the others.

    Attributes
    ----------
    untouched_hz
        Frequencies (m, 4) of the untouched plate, by the board's clock; None before they were measured.
    """

    def __init__(self, plate: Plate) -> None:
        self._codes = site_codes(plate)
        self._site_ids = plate.site_ids.tolist()
        self._touch_newton = TOUCH_SHARE * plate.force_max_newton
        self._moved_newton = MOVED_SHARE * plate.force_max_newton
        self._pressed_newton = PRESSED_SHARE * plate.force_max_newton if plate.calibration.id is not None else math.inf
        self._resting: list[Floats] = []  # (m, 4), hertz
        self.untouched_hz: Floats | None = None
        self._rest = np.zeros(self._codes.f0_hz.shape)  # shift while untouched, with the common mode
        self._before = self._rest  # shift of the reading before
        self._peak_newton = np.zeros(len(self._site_ids))  # on each site since that anchor
        self._anchor = self._untouched = (self._rest, np.zeros(CHANNEL_COUNT))  # shift and common mode of readings

    def read(self, reading: ToneReading) -> LoadReading | None:
        """Return the loads in a tone reading; None during the first second.

        Raises
        ------
        CalibrationRefusedError
            Touched within the first second.
        """
        time_s, tone = reading.time_s, self._codes.tone
        received_hz = reading.frequency_hz[tone]  # (m, 4)
        faults = tuple(self._fault(channel) if reading.complete else "frames are missing" for channel in received_hz.T)
        if any(faults):
            return _nothing(time_s, faults)
        if self.untouched_hz is None:
            self._begin(received_hz)
            return None
        return self._compare(time_s, self.untouched_hz, received_hz, reading.std[tone])

    def _fault(self, received_hz: Floats) -> str | None:
        silent = [str(self._site_ids[site]) for site in np.flatnonzero(~np.isfinite(received_hz))]
        return f"without sites {', '.join(silent)}" if silent else None

    def _begin(self, received_hz: Floats) -> None:
        """Add one reading of the untouched plate."""
        self._resting.append(received_hz)
        shift = np.array(self._resting) / self._resting[0] - 1.0
        moved = self._force(shift - shift.mean(axis=1, keepdims=True))
        self._refuse_touch(np.ptp(moved, axis=0), self._touch_newton)
        if len(self._resting) == REST_READINGS:
            self.untouched_hz = np.mean(self._resting, axis=0)
            off = self.untouched_hz / self._codes.f0_hz - 1.0
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

    def _compare(self, time_s: float, f0_hz: Floats, received_hz: Floats, std: Floats) -> LoadReading:
        shift = 1.0 - f0_hz / received_hz
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
        return LoadReading(
            time_s,
            (site if touched else PILOT,) * CHANNEL_COUNT,
            common,
            shift[site],
            std[site],
            oscillator_std(READING_S),
            (None,) * CHANNEL_COUNT,
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


def _nothing(time_s: float, faults: tuple[str | None, ...]) -> LoadReading:
    nothing = np.full(CHANNEL_COUNT, math.nan)
    tones = tuple(NOTHING if fault else PILOT for fault in faults)
    return LoadReading(time_s, tones, nothing, nothing, nothing, math.nan, faults)


OPEN_S: Final = 10.0  # in which a board must answer


def board_readings(capture: ToneCapture, timeout_s: float) -> Iterator[BoardOnline | ToneReading]:
    """Yield the board, and then its readings; raise an error where it is none for the plate, or none is there."""
    state = LinkChange(Condition.STARTING, OPENING, 0, 0)
    online = False
    last_s = time.monotonic()
    for arrival, reading in capture.arrivals():
        match arrival:
            case SingleToneFrame() | ChannelisedFrame():
                last_s = time.monotonic()
                if reading is not None:
                    yield reading
            case BoardOnline():
                online = True
                yield arrival
            case BoardRefused():
                error = IncompatibleBoardError if arrival.other_protocol else ConfigurationError
                raise error(*(problem.text for problem in arrival.problems))
            case LinkChange():
                state = arrival
                if arrival.state is Condition.WAITING and not online:
                    remedy = "a calibration needs the link for itself: stop the daemon that runs on it"
                    code = "port_in_use" if arrival.reason.code == "port_in_use" else "no_board"
                    raise UserError(f"link: {arrival.reason.text}; {remedy}", code=code, exit_code=ExitCode.UNAVAILABLE)
            case None if time.monotonic() - last_s > (timeout_s if online else OPEN_S):
                raise CalibrationRefusedError(
                    f"link {state.state}: {state.reason.text}; no frame came; the plate file is as before"
                )
