"""Tone readings of a board against the tones that its plate should send."""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.tones.tone_detector import ToneReading
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones

FEWEST_FRAMES: Final = 3  # of a reading
PAIRS: Final = tuple(combinations(range(CHANNEL_COUNT), 2))
_TONES_PAIRED: Final = 64  # more add nothing about two channels


@dataclass(frozen=True, slots=True)
class PlateReading:
    """A tenth of a second: of t tones that were expected, arrays (t, 4); NaN where one was not counted.

    Attributes
    ----------
    shift
        Relative, against the plate file: f / f0 - 1.
    std
        Relative, that noise of counter and oscillator give it.
    strange_hz
        (4,): frequency that is neither an expected tone nor a site's; NaN where there is none.
    pair_noise
        (6,): mean square of the difference between two channels from gate to gate, over what their noise gives.
    touched
        Whether a site is counted in the place of the pilot.
    scatter_radian
        (4,): standard deviation of an edge, as phase of the tone; NaN of a counter that has no edges.
    gates_counted
        (4,): share of gates in which a channel counts a tone, whether it runs on from the gate before or not.
    """

    time_s: float
    shift: Floats
    std: Floats
    strange_hz: Floats
    pair_noise: Floats
    touched: bool
    scatter_radian: Floats
    gates_counted: Floats


def plate_reading(reading: ToneReading, expected: ExpectedTones) -> PlateReading:
    """Return a tone reading against the tones of a plate."""
    shift = reading.frequency_hz / expected.f0_hz - 1.0
    std = np.hypot(reading.std, reading.oscillator_std)
    strange_hz = np.full(CHANNEL_COUNT, math.nan)
    gate_hz, touched = reading.gate_hz, False
    if expected.pressed_hz is not None:
        lowest_hz, highest_hz = expected.pressed_hz
        (tone_hz,), off = reading.frequency_hz, np.abs(shift[0]) >= expected.band[0]
        of_site = off & ((lowest_hz <= tone_hz) & (tone_hz <= highest_hz)).any(axis=0)
        touched = bool(of_site.any())
        strange_hz = np.where(off & ~of_site, tone_hz, math.nan)
        shift, std = np.where(off, math.nan, shift), np.where(off, math.nan, std)
        gate_hz = np.where(np.abs(gate_hz / expected.f0_hz.T - 1.0) < expected.band, gate_hz, math.nan)
    return PlateReading(
        reading.time_s,
        shift,
        std,
        strange_hz,
        _pair_noise(gate_hz, reading.gate_std_hz),
        touched,
        reading.scatter_radian,
        np.isfinite(reading.gate_hz).mean(axis=(0, 2)),
    )


def _pair_noise(gate_hz: Floats, std_hz: Floats) -> Floats:
    """Return the square of the difference of each two channels over that of their noise, (6,); arrays (k, 4, t).

    Differences of following gates take out what moves slowly, and the oscillator that both channels count.
    """
    first, second = np.transpose(PAIRS)
    gate_hz, std_hz = gate_hz[:, :, :_TONES_PAIRED], std_hz[1:, :, :_TONES_PAIRED]
    steps = np.diff(gate_hz[:, first] - gate_hz[:, second], axis=0)  # (k - 1, 6, t)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = steps**2 / (2.0 * (std_hz[:, first] ** 2 + std_hz[:, second] ** 2))
    return known_mean(known_mean(ratio, axis=0), axis=1)


def known_mean(values: Floats, axis: int) -> Floats:
    """Return the mean of the finite values along an axis, NaN where there is none."""
    mean: Floats = np.ma.masked_invalid(values).mean(axis=axis).filled(math.nan)
    return mean
