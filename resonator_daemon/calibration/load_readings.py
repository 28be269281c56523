"""Readings of a plate that is loaded site after site: on each corner the pilot, one site, or neither."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.arrays import Floats
from resonator_daemon.calibration.site_codes import site_codes
from resonator_daemon.plate import Plate
from resonator_daemon.tones.tone_detector import PILOT_TOLERANCE, ToneReading

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
