"""Frames of a board to what each tone does: readings of a tenth of a second, of untouched plates and touched ones."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Final, Protocol

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.arrays import Floats
from resonator_daemon.forces.force_tones import SIGMA_HZ
from resonator_daemon.plate import FORCE_SIGNAL, SKIN_SIGNALS, Plate
from resonator_daemon.sensors.single_tone_processing import BAND_MARGIN, PILOT_TOLERANCE
from resonator_daemon.session.frames import ChannelisedFrame, SingleToneFrame
from resonator_daemon.tones.frequency_estimators import Sums, counter_std, frequency_hz, oscillator_std, stamp_std_ticks
from resonator_daemon.tones.tone_merging import merge_tones
from resonator_daemon.tones.tone_windows import ToneWindows

READING_S: Final = 0.1
PAIRS: Final = tuple(combinations(range(CHANNEL_COUNT), 2))
_SPACING_SHARE: Final = 0.45  # of the way to the next tone, beyond which a tone is another's


@dataclass(frozen=True, slots=True)
class Reading:
    """A tenth of a second: of t tones that were expected, arrays (t, 4); NaN where one was not heard.

    Attributes
    ----------
    shift
        Relative, against the plate file: f / f0 - 1.
    std
        Relative, that noise of counter and oscillator give it.
    strange_hz
        (4,): what a channel hears that is neither an expected tone nor a site's; NaN where there is no such thing.
    pair_noise
        (6,): mean square of the difference between two channels from gate to gate, over what their noise gives.
    touched
        A site is heard in the place of the pilot.
    scatter_radian
        (4,): standard deviation of an edge, as phase of the tone; NaN of a counter that has no edges.
    """

    time_s: float
    shift: Floats
    std: Floats
    strange_hz: Floats
    pair_noise: Floats
    touched: bool
    scatter_radian: Floats


class Hearing(Protocol):
    """Takes frames, gives a reading with the last one of each tenth of a second."""

    tones: tuple[str, ...]  # what to call them
    f0_hz: Floats  # (t, 4)
    band: Floats  # (t,), relative: how far an untouched tone may be off

    def push(self, frame: SingleToneFrame | ChannelisedFrame) -> Reading | None: ...


class PilotHearing:
    """A single-tone counter: the pilot, while no site is touched."""

    def __init__(self, plate: Plate) -> None:
        self._gate_s = 1.0 / plate.counter.frame_rate_hz
        self._frames = max(3, round(READING_S / self._gate_s))
        self._reference_hz = plate.counter.reference_hz
        self._pilot_hz = plate.pilot_hz
        f0_hz, sensitivity = plate.tones.f0_hz, plate.tones.sensitivity
        pressed_hz = f0_hz * (1.0 + 1.1 * sensitivity * plate.force_max_newton)
        self._lowest_hz = np.minimum(f0_hz, pressed_hz) * (1.0 - PILOT_TOLERANCE)
        self._highest_hz = np.maximum(f0_hz, pressed_hz) * (1.0 + PILOT_TOLERANCE)
        tones_hz = (self._pilot_hz, float(f0_hz.min()), float(f0_hz.max()))
        band_hz = (1 - BAND_MARGIN) * min(tones_hz), (1 + BAND_MARGIN) * max(tones_hz)
        self._windows = ToneWindows(CHANNEL_COUNT, self._frames, self._reference_hz, band_hz)
        self._first: int | None = None
        self._gates: list[tuple[Floats, Floats]] = []  # frequency and its relative noise, (4,)
        self.tones: tuple[str, ...] = ("the pilot",)
        self.f0_hz = np.full((1, CHANNEL_COUNT), self._pilot_hz)
        self.band = np.array([PILOT_TOLERANCE])

    def push(self, frame: SingleToneFrame | ChannelisedFrame) -> Reading | None:
        if not isinstance(frame, SingleToneFrame):
            return None
        self._first = frame.index if self._first is None else self._first
        heard_hz, std = np.full((2, CHANNEL_COUNT), math.nan)
        block = self._windows.push(frame.payload)
        for channel, (fault, record) in enumerate(zip(block.fault_names(0), frame.records, strict=True)):
            if fault is None:
                sums = Sums.of(record)
                heard_hz[channel], std[channel] = frequency_hz(sums, self._reference_hz), counter_std(sums)
        self._gates.append((heard_hz, std))
        if (frame.index - self._first + 1) % self._frames:
            return None
        window = block.windows([0], [self._frames])
        return self._read(window.sums(0), (frame.index - self._first + 1 - 0.5 * self._frames) * self._gate_s)

    def _read(self, window: list[Sums | None], time_s: float) -> Reading:
        shift, std, strange_hz, scatter_radian = np.full((4, CHANNEL_COUNT), math.nan)
        sites = 0
        for channel, sums in enumerate(window):
            if sums is None:
                continue
            heard_hz = frequency_hz(sums, self._reference_hz)
            scatter_radian[channel] = 2.0 * math.pi * heard_hz * stamp_std_ticks(sums) / self._reference_hz
            if abs(heard_hz / self._pilot_hz - 1.0) < PILOT_TOLERANCE:
                shift[channel] = heard_hz / self._pilot_hz - 1.0
                std[channel] = math.hypot(counter_std(sums), oscillator_std(self._frames * self._gate_s))
            elif np.any((self._lowest_hz[:, channel] <= heard_hz) & (heard_hz <= self._highest_hz[:, channel])):
                sites += 1
            else:
                strange_hz[channel] = heard_hz
        frequency, noise = (np.array(part) for part in zip(*self._gates, strict=True))
        self._gates.clear()
        frequency = np.where(np.abs(frequency / self._pilot_hz - 1.0) < PILOT_TOLERANCE, frequency, math.nan)
        pairs = _pair_noise(frequency / self._pilot_hz, noise)
        return Reading(time_s, shift[None], std[None], strange_hz, pairs, sites > 0, scatter_radian)


class ToneHearing:
    """A channelised counter: all tones, all the time."""

    def __init__(self, plate: Plate, oscillator_hz: Floats) -> None:
        """`oscillator_hz` (tones,) is what the board counts each tone against."""
        tones = plate.tones
        self._gate_s = 1.0 / plate.counter.frame_rate_hz
        self._frames = max(3, round(READING_S / self._gate_s))
        self._oscillator_hz = oscillator_hz
        self._first: int | None = None
        self._held: list[ChannelisedFrame] = []
        self.f0_hz = tones.f0_hz
        self.tones = tuple(
            f"site {plate.site_ids[site]}" + ("" if plate.signals == (FORCE_SIGNAL,) else f" {plate.signals[signal]}")
            for site, signal in zip(tones.site_index, tones.signal_index, strict=True)
        )
        self.band = self._bands(plate)

    def _bands(self, plate: Plate) -> Floats:
        """Half the way to the next tone; of a force site no more than reference and force can do together."""
        mean_hz = self.f0_hz.mean(axis=1)
        order = np.argsort(mean_hz)
        apart = np.diff(mean_hz[order]) / mean_hz[order][:-1] if len(order) > 1 else np.array([math.inf])
        nearest = np.empty(len(order))
        nearest[order] = np.minimum(np.concatenate([[math.inf], apart]), np.concatenate([apart, [math.inf]]))[
            : len(order)
        ]
        band: Floats = _SPACING_SHARE * nearest
        if plate.signals == SKIN_SIGNALS:
            return band
        reach = PILOT_TOLERANCE + np.abs(plate.tones.sensitivity).max(axis=1) * plate.force_max_newton
        of_force = plate.tones.signal_index == plate.signals.index(FORCE_SIGNAL)
        return np.where(of_force, np.minimum(band, reach), band)

    def push(self, frame: SingleToneFrame | ChannelisedFrame) -> Reading | None:
        if not isinstance(frame, ChannelisedFrame):
            return None
        self._first = frame.index if self._first is None else self._first
        self._held.append(frame)
        if (frame.index - self._first + 1) % self._frames:
            return None
        return self._read((frame.index - self._first + 1 - 0.5 * self._frames) * self._gate_s)

    def _read(self, time_s: float) -> Reading:
        held, self._held = self._held, []
        phase, offset, code, known = (
            np.array([getattr(frame, name) for frame in held])
            for name in ("phase_turn32", "offset_hz16", "sigma_code", "known")
        )
        sigma_hz = SIGMA_HZ[code]
        merged = merge_tones(phase, offset, sigma_hz, known, self._gate_s)
        shift = (self._oscillator_hz[:, None] + merged.offset_hz.T) / self.f0_hz - 1.0
        std = np.hypot(merged.sigma_hz.T / self.f0_hz, oscillator_std(self._frames * self._gate_s))
        gates = np.where(known, offset / 2.0**16, math.nan)  # (k, 4, t)
        pairs = np.nanmean(
            [
                _pair_noise(gates[:, :, tone], sigma_hz[:, :, tone])
                for tone in range(min(gates.shape[2], _TONES_PAIRED))
            ],
            axis=0,
        )
        nothing = np.full(CHANNEL_COUNT, math.nan)
        return Reading(time_s, shift, std, nothing, pairs, False, nothing)


_TONES_PAIRED: Final = 64  # more say no more about two channels


def make_hearing(plate: Plate, oscillator_hz: Floats) -> Hearing:
    """Return what listens to a plate; `oscillator_hz` (tones,) of a channelised board."""
    return PilotHearing(plate) if plate.counter.kind == "single-tone" else ToneHearing(plate, oscillator_hz)


def _pair_noise(value: Floats, std: Floats) -> Floats:
    """Compare the difference of each two channels, from gate to gate, with their noise; (k, 4) each, NaN where unheard.

    Differences of following gates take out what moves slowly, and the oscillator that both channels hear.
    """
    return np.array(list(_pairs(value, std)))


def _pairs(value: Floats, std: Floats) -> Iterator[float]:
    for first, second in PAIRS:
        steps = np.diff(value[:, first] - value[:, second])
        expected = 2.0 * (std[:, first] ** 2 + std[:, second] ** 2)[1:]
        ratio = steps**2 / expected
        usable = np.isfinite(ratio)
        yield float(ratio[usable].mean()) if usable.any() else math.nan
