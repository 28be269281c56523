"""Tone readings over a tenth of a second, from frames of either kind of counter."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT, SingleToneRecord
from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.tones.frequency_estimators import (
    Sums,
    counter_std,
    frequency_hz,
    oscillator_std,
    stamp_std_ticks,
)
from resonator_daemon.estimate.tones.tone_merging import SIGMA_HZ, merge_tones
from resonator_daemon.estimate.tones.tone_windows import ToneWindows, Window

READING_S: Final = 0.1
PILOT_TOLERANCE: Final = 100e-6  # reference error and temperature together stay below it
BAND_MARGIN: Final = 0.05  # beyond the plate's tones no press and no clock error can reach


def capture_band_hz(pilot_hz: float, f0_hz: Floats) -> tuple[float, float]:
    """Return the lowest and the highest frequency that a plate with these tones could ever send."""
    lowest_hz, highest_hz = min(pilot_hz, float(f0_hz.min())), max(pilot_hz, float(f0_hz.max()))
    return (1 - BAND_MARGIN) * lowest_hz, (1 + BAND_MARGIN) * highest_hz


def reading_frames(gate_s: float, fewest: int = 1) -> int:
    """Return the number of frames in a reading."""
    return max(fewest, round(READING_S / gate_s))


@dataclass(frozen=True)
class ToneReading:
    """Frequencies of t tones on four channels over one window; t is 1 for a counter that captures a tone.

    Attributes
    ----------
    time_s
        Middle of the window, since the first frame.
    frequency_hz
        (t, 4), NaN where a tone was not counted during the whole window.
    std
        (t, 4), relative, from noise of the counter.
    oscillator_std
        Relative, from noise of the oscillators.
    faults
        By channel: why there is no frequency; None where there is one.
    complete
        Whether no frame of the window is missing.
    scatter_radian
        (4,), standard deviation of an edge, as phase of the tone; NaN for a counter without edges.
    gate_hz
        (k, 4, t): frequency of each gate, NaN where there is none.
    """

    time_s: float
    frequency_hz: Floats
    std: Floats
    oscillator_std: float
    faults: tuple[str | None, ...]
    complete: bool
    scatter_radian: Floats
    gate_hz: Floats


class ToneDetector(Protocol):
    """Makes tone readings of frames."""

    def push(self, frame: Any) -> ToneReading | None:
        """Add a frame; return a reading with the last frame of each window."""


class CapturedFrame(Protocol):
    """Frame of a counter that captures one tone per channel."""

    @property
    def index(self) -> int: ...

    @property
    def payload(self) -> bytes: ...

    @property
    def records(self) -> tuple[SingleToneRecord, ...]: ...


class CapturedToneDetector:
    """Readings of the one tone that each channel captures.

    Parameters
    ----------
    frames
        Number of frames in a reading.
    reference_hz
        Rate of the board's ticks.
    gate_s
        Length of a gate.
    band_hz
        Lowest and highest frequency that the plate could send.
    """

    def __init__(self, frames: int, reference_hz: float, gate_s: float, band_hz: tuple[float, float]) -> None:
        self._frames = frames
        self._reference_hz = reference_hz
        self._gate_s = gate_s
        self._windows = ToneWindows(CHANNEL_COUNT, frames, reference_hz, band_hz)
        self._first: int | None = None
        self._gates: list[Floats] = []

    def push(self, frame: CapturedFrame) -> ToneReading | None:
        """Add a frame; return a reading with the last frame of each window. After a gap it has no frequency."""
        self._first = frame.index if self._first is None else self._first
        window = self._windows.push(frame.payload).window(0, self._frames)
        gate_hz = np.full(CHANNEL_COUNT, math.nan)
        for channel, (fault, record) in enumerate(zip(window.faults, frame.records, strict=True)):
            if fault is None:
                gate_hz[channel] = frequency_hz(Sums.of(record), self._reference_hz)
        self._gates.append(gate_hz)
        count = frame.index - self._first + 1
        if count % self._frames:
            return None
        return self._read(window, (count - 0.5 * self._frames) * self._gate_s)

    def _read(self, window: Window, time_s: float) -> ToneReading:
        hertz, std, scatter_radian = np.full((3, CHANNEL_COUNT), math.nan)
        for channel, sums in enumerate(window.sums):
            if sums is not None:
                hertz[channel], std[channel] = frequency_hz(sums, self._reference_hz), counter_std(sums)
                scatter_radian[channel] = 2.0 * math.pi * hertz[channel] * stamp_std_ticks(sums) / self._reference_hz
        gate_hz = np.array(self._gates)[..., None]
        self._gates.clear()
        return ToneReading(
            time_s,
            hertz[None],
            std[None],
            oscillator_std(self._frames * self._gate_s),
            tuple(
                None if sums is not None else fault or "no steady tone"
                for sums, fault in zip(window.sums, window.faults, strict=True)
            ),
            len(gate_hz) == self._frames,
            scatter_radian,
            gate_hz,
        )


class MultitoneFrame(Protocol):
    """Frame of a counter of all tones; arrays (4, t) in the wire's units."""

    @property
    def index(self) -> int: ...

    @property
    def phase_turn32(self) -> NDArray[np.int32]: ...

    @property
    def offset_hz16(self) -> NDArray[np.int32]: ...

    @property
    def sigma_code(self) -> NDArray[np.uint8]: ...

    @property
    def known(self) -> NDArray[np.bool_]: ...


class MultitoneDetector:
    """Readings of all tones.

    Parameters
    ----------
    frames
        Number of frames in a reading.
    gate_s
        Length of a gate.
    oscillator_hz
        (t,), what the board counts each tone against.
    """

    def __init__(self, frames: int, gate_s: float, oscillator_hz: Floats) -> None:
        self._held: deque[MultitoneFrame] = deque(maxlen=frames)
        self._frames = frames
        self._gate_s = gate_s
        self._oscillator_hz = oscillator_hz
        self._first: int | None = None

    def push(self, frame: MultitoneFrame) -> ToneReading | None:
        """Add a frame; return a reading with the last frame of each window. Frames before a gap are left out."""
        self._first = frame.index if self._first is None else self._first
        if self._held and frame.index != self._held[-1].index + 1:
            self._held.clear()
        self._held.append(frame)
        count = frame.index - self._first + 1
        return None if count % self._frames else self._read((count - 0.5 * self._frames) * self._gate_s)

    def _read(self, time_s: float) -> ToneReading:
        phase = np.array([frame.phase_turn32 for frame in self._held])
        offset = np.array([frame.offset_hz16 for frame in self._held])
        sigma_hz = SIGMA_HZ[np.array([frame.sigma_code for frame in self._held])]
        known = np.array([frame.known for frame in self._held])
        merged = merge_tones(phase, offset, sigma_hz, known, self._gate_s)
        hertz = self._oscillator_hz[:, None] + merged.offset_hz.T
        return ToneReading(
            time_s,
            hertz,
            merged.sigma_hz.T / hertz,
            oscillator_std(self._frames * self._gate_s),
            (None,) * CHANNEL_COUNT,
            len(self._held) == self._frames,
            np.full(CHANNEL_COUNT, math.nan),
            np.where(known, offset / 2.0**16, math.nan),
        )
