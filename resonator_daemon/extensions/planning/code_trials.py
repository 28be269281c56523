"""Monte Carlo of code mistakes: random plates, touches and readings, identified by a matcher.

Of a plate, f0 is drawn within `placement` and, by corner, `pulling`, and K within `sensitivity_spread`. Of a touch: a
force up to the largest; a temperature within the span, of which each site takes the share of a coefficient with
`tempco_std`; ageing, half of `ageing` up or down; K off by `model_error` at each corner. Of a reading: noise of counter
and oscillator, and of all tones together.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.forces.codes import code_overlaps
from resonator_daemon.estimate.forces.site_identification import Match, Matcher
from resonator_daemon.extensions.planning.code_ladder import Tolerances

LEAST_NEWTON: Final = 0.02  # of a touch: where a contact begins
COMMON_STD: Final = 2e-7  # of what is left of the common mode, estimated from a pilot


class Codes(NamedTuple):
    """Codes of one plate, (m, channels), K in 1/N."""

    f0_hz: Floats
    sensitivity: Floats


class Outcomes(NamedTuple):
    """Counts of touches: all pressed sites named, only some of them, another one named, and none named.

    A site whose force is an overload counts as named.
    """

    right: int = 0
    partly: int = 0
    wrong: int = 0
    undecided: int = 0

    @property
    def touches(self) -> int:
        return sum(self)

    def plus(self, other: "Outcomes") -> "Outcomes":
        return Outcomes(*(a + b for a, b in zip(self, other, strict=True)))


def draw_plate(codes: Codes, tolerances: Tolerances, random: np.random.Generator) -> Codes:
    """Make one plate that was meant to have these codes."""
    sites = (len(codes.f0_hz), 1)
    place = random.uniform(-tolerances.placement, tolerances.placement, sites)
    pull = random.uniform(-tolerances.pulling, tolerances.pulling, codes.f0_hz.shape)
    spread = random.uniform(-tolerances.sensitivity_spread, tolerances.sensitivity_spread, sites)
    return Codes(codes.f0_hz * (1.0 + place + pull), codes.sensitivity * (1.0 + spread))


def overlaps(codes: Codes, tolerances: Tolerances) -> bool:
    """Return whether two sites of a plate can be mistaken for each other within the tolerances."""
    thermal = tolerances.tempco_difference_per_kelvin * tolerances.temperature_span_kelvin / 2.0
    largest_shift = float(np.abs(codes.sensitivity).max()) * tolerances.force_max_newton
    found = code_overlaps(
        *codes,
        tolerances.force_max_newton,
        common_shift=tolerances.ageing + thermal,
        margin=10.0 * math.hypot(tolerances.counter_std, tolerances.oscillator_std)
        + 2.0 * tolerances.model_error * largest_shift,
    )
    return bool(found)


def one_touch(codes: Codes, tolerances: Tolerances, touches: int, random: np.random.Generator) -> Outcomes:
    """Press sites one by one."""
    site = random.integers(0, len(codes.f0_hz), touches)
    force = random.uniform(LEAST_NEWTON, tolerances.force_max_newton, touches)
    detected = np.broadcast_to(site[:, None], (touches, codes.f0_hz.shape[1]))
    return _outcomes(_match(codes, tolerances, detected, force[:, None], random), np.stack([site, site], axis=1))


def two_touches(codes: Codes, tolerances: Tolerances, touches: int, random: np.random.Generator) -> Outcomes:
    """Press two sites at a time; each channel follows either with equal probability."""
    sites = random.permuted(np.tile(np.arange(len(codes.f0_hz)), (touches, 1)), axis=1)[:, :2]
    force = random.uniform(LEAST_NEWTON, tolerances.force_max_newton, (touches, 2))
    choice = random.integers(0, 2, (touches, codes.f0_hz.shape[1]))
    detected = np.take_along_axis(sites, choice, axis=1)
    return _outcomes(_match(codes, tolerances, detected, np.take_along_axis(force, choice, axis=1), random), sites)


def _match(
    codes: Codes, tolerances: Tolerances, detected: NDArray[np.int64], force_newton: Floats, random: np.random.Generator
) -> list[Match]:
    """Identify n touches: `detected` (n, channels) are the sites read, `force_newton` broadcasts to that."""
    touches, shape = len(detected), detected.shape
    channel = np.arange(shape[1])
    half_span = tolerances.temperature_span_kelvin / 2.0
    tempco = random.normal(0.0, tolerances.tempco_std, len(codes.f0_hz))
    age = random.uniform(-tolerances.ageing / 2.0, tolerances.ageing / 2.0, len(codes.f0_hz))
    shift = age[detected] + tempco[detected] * random.uniform(-half_span, half_span, (touches, 1))
    shift = shift + random.normal(0.0, math.hypot(COMMON_STD, tolerances.oscillator_std), (touches, 1))
    shift += random.normal(0.0, tolerances.counter_std, shape)
    sensitivity = codes.sensitivity[detected, channel] * (1.0 + random.normal(0.0, tolerances.model_error, shape))
    tone = codes.f0_hz[detected, channel] * (1.0 + shift) / (1.0 - sensitivity * force_newton)
    matcher = Matcher(*codes, tolerances.force_max_newton, model_error=tolerances.model_error)
    counter_std = [tolerances.counter_std] * shape[1]
    return [
        matcher.match(frequency_hz, counter_std, tolerances.oscillator_std, COMMON_STD)
        for frequency_hz in tone.tolist()
    ]


def _outcomes(matches: Sequence[Match], pressed: NDArray[np.int64]) -> Outcomes:
    """Compare with the sites (n, 2) that were pressed; for a single touch, both columns have the same site."""
    counts = Counter[str]()
    for match, sites in zip(matches, pressed.tolist(), strict=True):
        named, touched = {force.site for force in match.forces}, set(sites)
        if not named <= touched:
            counts["wrong"] += 1
        elif named:
            counts["right" if named == touched else "partly"] += 1
        else:
            counts["undecided"] += 1
    return Outcomes(**counts)
