"""Readings of a board whose plate is loaded site after site: on each corner the pilot, one site, or neither."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import ConfigurationError, IncompatibleBoardError
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from resonator_daemon.base.reasons import Condition
from resonator_daemon.board.config import Config
from resonator_daemon.board.recording.event_replay import replay_of
from resonator_daemon.board.session.frames import (
    BoardOnline,
    BoardRefused,
    ChannelisedFrame,
    LinkChange,
    SingleToneFrame,
)
from resonator_daemon.board.session.link_reasons import OPENING
from resonator_daemon.estimate.tones.tone_detector import PILOT_TOLERANCE, ToneReading
from resonator_daemon.measure.pipeline.tone_capture import ToneCapture
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError, LinkBusyError


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


OPEN_S: Final = 10.0  # in which a board must answer


@contextmanager
def board_readings(config: Config, timeout_s: float) -> Iterator[Iterator[BoardOnline | ToneReading]]:
    """Yield an iterator over the board and then its readings."""
    with ToneCapture(config.link, config.plate, replay=replay_of(config.link, config.plate)) as capture:
        yield _readings(capture, timeout_s)


def _readings(capture: ToneCapture, timeout_s: float) -> Iterator[BoardOnline | ToneReading]:
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
                    raise LinkBusyError(
                        f"link: {arrival.reason.text}; {remedy}", in_use=arrival.reason.code == "port_in_use"
                    )
            case None if time.monotonic() - last_s > (timeout_s if online else OPEN_S):
                raise CalibrationRefusedError(
                    f"link {state.state}: {state.reason.text}; no frame came; the plate file is as before"
                )
