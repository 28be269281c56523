"""Tones that an untouched plate sends, with what each may be off by: expectations of a diagnosis."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from resonator_daemon.estimate.tones.tone_detector import PILOT_TOLERANCE

_SPACING_SHARE: Final = 0.45  # of the way to the next tone, beyond which a tone is another's


@dataclass(frozen=True)
class ExpectedTones:
    """Expectations of t tones.

    Attributes
    ----------
    names
        For texts.
    f0_hz
        (t, 4).
    band
        (t,), relative: how far an untouched tone may be off.
    pressed_hz
        (2, s, 4): lowest and highest frequency of each site that takes the place of these tones while it is touched;
        None if every tone is counted all the time.
    """

    names: tuple[str, ...]
    f0_hz: Floats
    band: Floats
    pressed_hz: Floats | None = None


def captured_tones(plate: Plate) -> ExpectedTones:
    """Return the expectation of the pilot, which touched sites replace."""
    f0_hz = plate.tones.f0_hz
    pressed_hz = f0_hz * (1.0 + 1.1 * plate.tones.sensitivity * plate.force_max_newton)
    limits_hz = np.array(
        [
            np.minimum(f0_hz, pressed_hz) * (1.0 - PILOT_TOLERANCE),
            np.maximum(f0_hz, pressed_hz) * (1.0 + PILOT_TOLERANCE),
        ]
    )
    pilot_hz = np.full((1, CHANNEL_COUNT), plate.pilot_hz)
    return ExpectedTones(("the pilot",), pilot_hz, np.array([PILOT_TOLERANCE]), limits_hz)


def all_tones(plate: Plate) -> ExpectedTones:
    """Return the expectation of tones that are all counted; the band of each is half the way to the next one."""
    tones = plate.tones
    names = tuple(
        f"site {plate.site_ids[site]}" + ("" if plate.signals == (FORCE_SIGNAL,) else f" {plate.signals[signal]}")
        for site, signal in zip(tones.site_index, tones.signal_index, strict=True)
    )
    mean_hz = tones.f0_hz.mean(axis=1)
    order = np.argsort(mean_hz)
    apart = np.concatenate([[math.inf], np.diff(mean_hz[order]) / mean_hz[order][:-1], [math.inf]])
    band = np.empty(len(order))
    band[order] = _SPACING_SHARE * np.minimum(apart[:-1], apart[1:])
    return ExpectedTones(names, tones.f0_hz, band)


def force_tones(plate: Plate) -> ExpectedTones:
    """Return the expectation of tones that are all counted; force sites move no further than clock and force do."""
    expected = all_tones(plate)
    reach = PILOT_TOLERANCE + np.abs(plate.tones.sensitivity).max(axis=1) * plate.force_max_newton
    of_force = plate.tones.signal_index == plate.signals.index(FORCE_SIGNAL)
    band = np.where(of_force, np.minimum(expected.band, reach), expected.band)
    return ExpectedTones(expected.names, expected.f0_hz, band)
