"""What each corner of a single-tone plate hears in a tenth of a second: the pilot, one site, or neither."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.arrays import Floats
from resonator_daemon.calibration.site_codes import site_codes
from resonator_daemon.plate import Plate
from resonator_daemon.sensors.single_tone_processing import BAND_MARGIN, PILOT_TOLERANCE
from resonator_daemon.tones.frequency_estimators import counter_std, frequency_hz, oscillator_std
from resonator_daemon.tones.gate_block import GateBlock
from resonator_daemon.tones.tone_windows import ToneWindows

READING_S: Final = 0.1
PILOT: Final = -1
NOTHING: Final = -2  # no tone, or none for the whole reading


@dataclass(frozen=True)
class Heard:
    """One reading: relative shifts by channel (4,), NaN where they do not apply.

    `tone` and `shift` are of the loaded site where all sites are heard; `pilot_shift` is then that of their mean.
    """

    time_s: float  # at its middle, since the first frame
    tone: tuple[int, ...]  # by channel: a site's index, PILOT or NOTHING
    pilot_shift: Floats  # f / f_pilot - 1
    shift: Floats  # 1 - f0 / f of the site heard, the common mode still in it
    std: Floats  # relative, of the counter
    oscillator_std: float  # relative, common to the channels
    faults: tuple[str, ...]  # by channel, empty where a tone is heard
    site_shift: Floats | None = None  # (sites, 4), where all sites are heard

    @property
    def untouched(self) -> bool:
        return all(tone == PILOT for tone in self.tone)

    @property
    def touched(self) -> int | None:
        """Index of a site that at least two channels hear; the one that most hear."""
        sites = [tone for tone in self.tone if tone >= 0]
        best = max(set(sites), key=sites.count, default=None)
        return best if best is not None and sites.count(best) > 1 else None


class Ear:
    """Frames of a single-tone plate to readings."""

    def __init__(self, plate: Plate) -> None:
        self._gate_s = 1.0 / plate.counter.frame_rate_hz
        self._frames = max(1, round(READING_S / self._gate_s))
        codes = site_codes(plate)
        self._f0_hz, self._sensitivity = codes.f0_hz, codes.sensitivity
        self._force_max_newton = plate.force_max_newton
        self._pilot_hz = plate.pilot_hz
        self._reference_hz = plate.counter.reference_hz
        tones_hz = [plate.pilot_hz, float(self._f0_hz.min()), float(self._f0_hz.max())]
        band_hz = (1 - BAND_MARGIN) * min(tones_hz), (1 + BAND_MARGIN) * max(tones_hz)
        self._windows = ToneWindows(CHANNEL_COUNT, self._frames, self._reference_hz, band_hz)
        self._first: int | None = None

    def push(self, index: int, payload: bytes) -> Heard | None:
        """Take one frame, its records as on the wire; gives a reading with the last frame of each tenth of a second.

        Where frames are missing, stamps do not run on, and the reading hears nothing.
        """
        self._first = index if self._first is None else self._first
        block = self._windows.push(payload)
        if (index - self._first + 1) % self._frames:
            return None
        return self._read(block, (index - self._first + 1) * self._gate_s - 0.5 * self._frames * self._gate_s)

    def _read(self, block: GateBlock, time_s: float) -> Heard:
        tone = [NOTHING] * CHANNEL_COUNT
        pilot_shift, shift, std = np.full((3, CHANNEL_COUNT), math.nan)
        faults = []
        window = block.windows([0], [self._frames]).sums(0)
        for channel, (sums, fault) in enumerate(zip(window, block.fault_names(0), strict=True)):
            faults.append("" if sums is not None else fault or "no steady tone")
            if sums is None:
                continue
            heard_hz = frequency_hz(sums, self._reference_hz)
            std[channel] = counter_std(sums)
            if abs(heard_hz / self._pilot_hz - 1) < PILOT_TOLERANCE:
                tone[channel], pilot_shift[channel] = PILOT, heard_hz / self._pilot_hz - 1
            else:
                tone[channel] = site = self._nearest(heard_hz, channel)
                shift[channel] = 1 - self._f0_hz[site, channel] / heard_hz
        return Heard(
            time_s,
            tuple(tone),
            pilot_shift,
            shift,
            std,
            oscillator_std(self._frames * self._gate_s),
            tuple(faults),
        )

    def _nearest(self, heard_hz: float, channel: int) -> int:
        """Site whose tone, under any force in its range, comes nearest."""
        shift = 1 - self._f0_hz[:, channel] / heard_hz
        sensitivity = self._sensitivity[:, channel]
        force = np.clip(shift / sensitivity, 0.0, self._force_max_newton)
        return int(np.abs(shift - sensitivity * force).argmin())
