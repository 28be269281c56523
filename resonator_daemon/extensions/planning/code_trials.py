"""Monte Carlo of code mistakes: random plates, touches and readings, identified by a matcher."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.forces.codes import code_overlaps
from resonator_daemon.estimate.forces.site_identification import Match, Matcher
from resonator_daemon.extensions.planning.code_ladder import Limits

LEAST_NEWTON: Final = 0.02  # of a touch: where a contact begins


@dataclass(frozen=True)
class Scatter(Limits):
    """What is drawn. Of a plate: f0 within `tolerance` and, by corner, `pulling`; K within `sensitivity_spread`.

    Of a touch: a force up to `force_max_newton`; a temperature within the span, of which each site takes the share of a
    coefficient with `tempco_std` in 1/K; ageing, half of `ageing` up or down; K off by `model_error` at each corner. Of
    a reading: noise of counter and oscillator, and of all tones together, normal with `common_std` or, with
    `common_shift`, even within that. All but newton, kelvin and 1/K relative.
    """

    sensitivity_spread: float
    tempco_std: float
    model_error: float
    counter_std: float
    oscillator_std: float
    common_std: float

    @property
    def common_mode_std(self) -> float:
        """Common-mode variance given to the matcher."""
        return math.hypot(self.common_std, self.common_shift / math.sqrt(3.0))


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


def draw_plate(codes: Codes, scatter: Scatter, random: np.random.Generator) -> Codes:
    """Make one plate that was meant to have these codes."""
    sites = (len(codes.f0_hz), 1)
    place = random.uniform(-scatter.tolerance, scatter.tolerance, sites)
    pull = random.uniform(-scatter.pulling, scatter.pulling, codes.f0_hz.shape)
    spread = random.uniform(-scatter.sensitivity_spread, scatter.sensitivity_spread, sites)
    return Codes(codes.f0_hz * (1.0 + place + pull), codes.sensitivity * (1.0 + spread))


def overlaps(codes: Codes, scatter: Scatter) -> bool:
    """Return whether two sites of a plate can be mistaken for each other within the tolerances."""
    thermal = scatter.tempco_difference_per_kelvin * scatter.temperature_span_kelvin / 2.0
    largest_shift = float(np.abs(codes.sensitivity).max()) * scatter.force_max_newton
    found = code_overlaps(
        *codes,
        scatter.force_max_newton,
        common_shift=scatter.ageing + thermal + scatter.common_shift,
        margin=10.0 * math.hypot(scatter.counter_std, scatter.oscillator_std)
        + 2.0 * scatter.model_error * largest_shift,
    )
    return bool(found)


def one_touch(codes: Codes, scatter: Scatter, touches: int, random: np.random.Generator) -> Outcomes:
    """Press sites one by one."""
    site = random.integers(0, len(codes.f0_hz), touches)
    force = random.uniform(LEAST_NEWTON, scatter.force_max_newton, touches)
    detected = np.broadcast_to(site[:, None], (touches, codes.f0_hz.shape[1]))
    return _outcomes(_match(codes, scatter, detected, force[:, None], random), np.stack([site, site], axis=1))


def two_touches(codes: Codes, scatter: Scatter, touches: int, random: np.random.Generator) -> Outcomes:
    """Press two sites at a time; each channel follows either with equal probability."""
    sites = random.permuted(np.tile(np.arange(len(codes.f0_hz)), (touches, 1)), axis=1)[:, :2]
    force = random.uniform(LEAST_NEWTON, scatter.force_max_newton, (touches, 2))
    choice = random.integers(0, 2, (touches, codes.f0_hz.shape[1]))
    detected = np.take_along_axis(sites, choice, axis=1)
    return _outcomes(_match(codes, scatter, detected, np.take_along_axis(force, choice, axis=1), random), sites)


def nearest_wrong(
    codes: Codes, force_max_newton: float, common_shift: float, touches: int, random: np.random.Generator
) -> int:
    """Count touches for which the band nearest to the tone, on the first channel, is another site's.

    Forces are even within the range, and all tones are off by `common_shift`, up or down. This is the decoding that
    leaves nothing undecided: it shows what a ladder alone can bear.
    """
    f0_hz, sensitivity = codes.f0_hz[:, 0], codes.sensitivity[:, 0]
    site = random.integers(0, len(f0_hz), touches)
    force = random.uniform(0.0, force_max_newton, touches)
    error = common_shift * random.choice([-1.0, 1.0], touches)
    tone = np.log(f0_hz[site]) - np.log1p(-sensitivity[site] * force) + error
    ends = np.log(f0_hz)[:, None] - np.log1p(-sensitivity[:, None] * np.array([0.0, force_max_newton]))
    away = np.maximum(ends.min(axis=1) - tone[:, None], tone[:, None] - ends.max(axis=1))
    return int((np.maximum(away, 0.0).argmin(axis=1) != site).sum())


def _match(
    codes: Codes, scatter: Scatter, detected: NDArray[np.int64], force_newton: Floats, random: np.random.Generator
) -> list[Match]:
    """Identify n touches: `detected` (n, channels) are the sites read, `force_newton` broadcasts to that."""
    touches, shape = len(detected), detected.shape
    channel = np.arange(shape[1])
    half_span = scatter.temperature_span_kelvin / 2.0
    tempco = random.normal(0.0, scatter.tempco_std, len(codes.f0_hz))
    age = random.uniform(-scatter.ageing / 2.0, scatter.ageing / 2.0, len(codes.f0_hz))
    shift = age[detected] + tempco[detected] * random.uniform(-half_span, half_span, (touches, 1))
    shift = shift + random.normal(0.0, scatter.common_std, (touches, 1))
    shift += random.uniform(-scatter.common_shift, scatter.common_shift, (touches, 1))
    shift += random.normal(0.0, scatter.oscillator_std, (touches, 1)) + random.normal(0.0, scatter.counter_std, shape)
    sensitivity = codes.sensitivity[detected, channel] * (1.0 + random.normal(0.0, scatter.model_error, shape))
    tone = codes.f0_hz[detected, channel] * (1.0 + shift) / (1.0 - sensitivity * force_newton)
    matcher = Matcher(*codes, scatter.force_max_newton, model_error=scatter.model_error)
    counter_std = [scatter.counter_std] * shape[1]
    return [
        matcher.match(frequency_hz, counter_std, scatter.oscillator_std, scatter.common_mode_std)
        for frequency_hz in tone.tolist()
    ]


def _outcomes(matches: Sequence[Match], pressed: NDArray[np.int64]) -> Outcomes:
    """Compare with the sites (n, 2) that were pressed; one alone stands there twice."""
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
