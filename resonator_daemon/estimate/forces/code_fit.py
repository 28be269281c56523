"""Least-squares force of a code on the channels that follow it, and of groups of channels that follow several codes.

In plain floats: for four channels, arrays take ten times as long.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import chain, combinations
from operator import mul
from typing import Final, Literal, NamedTuple

from resonator_daemon.base.reasons import Reason, ReasonCode

GATE_PROBABILITY: Final = 1e-3  # of a true touch beyond the gate: 10.83, 13.82, 16.27 for 1, 2, 3 degrees of freedom
DOUBT_STD: Final = 3.0  # of the first fit's force: what it may fall short of the force that makes the model error
RUNNER_UP_GAP: Final = 13.8  # of scores: twice the log of odds of 1000 : 1

LEAVE_ONE_OUT_CHANNELS: Final = 4  # with fewer, what is left is too little to convict a channel
SITES_ALIKE: Final = Reason(ReasonCode.SITES_ALIKE, "two sites explain the channels alike")
_NO_SITE: Final = Reason(ReasonCode.NO_SITE_FITS, "no site explains the channels")
_SEVERAL: Final = Reason(ReasonCode.SEVERAL_SITES, "channels detect different sites")

Group = tuple[int, ...]  # of channels


class Code(NamedTuple):
    """Code of one site, by channel, K in 1/N."""

    f0_hz: list[float]
    sensitivity: list[float]


class Codes(NamedTuple):
    """Codes by site, K known to the relative `model_error`; and the range of forces."""

    sites: list[Code]
    model_error: float
    range_newton: tuple[float, float]


class Reading(NamedTuple):
    """One reading of the channels; where one is not used, 1 Hz and variances of 0."""

    frequency_hz: list[float]
    counter_variance: list[float]
    inverse_variance: list[float]
    oscillator_variance: float
    common_mode_variance: float

    @property
    def channels(self) -> tuple[int, ...]:
        """Return the channels in use."""
        return tuple([channel for channel, inverse in enumerate(self.inverse_variance) if inverse > 0.0])

    def on(self, channels: tuple[int, ...]) -> "Reading":
        """Return the reading with only these channels in use."""
        inverse = [value if channel in channels else 0.0 for channel, value in enumerate(self.inverse_variance)]
        return self._replace(inverse_variance=inverse)


class CodeFit(NamedTuple):
    """Fit of one code: F is the sum of `weights`, by channel, times shifts.

    `chi2` and `score` (chi2 + ln det R) are those of the force nearest to `force_newton` within the range.
    """

    site: int
    force_newton: float
    chi2: float
    score: float
    weights: list[float]


@cache
def gates(channels: int) -> list[float]:
    """Largest accepted chi2 of a fit on 0, 1, ... channels; on one channel only the range limits it."""
    return [_gate(max(count - 1, 1)) for count in range(channels + 1)]


def _gate(freedom: int) -> float:
    """Return the chi2 that is exceeded with the probability of the gate.

    Written here, as closed forms hold for whole degrees of freedom: importing `scipy.special` takes 0.2 s.
    """
    low, high = 0.0, 100.0 * freedom
    while low < (middle := 0.5 * (low + high)) < high:
        half = 0.5 * middle
        tail = math.erfc(math.sqrt(half)) if freedom % 2 else 0.0
        powers = (0.5 * freedom - count for count in range(1, freedom // 2 + 1))
        tail += sum(half**power * math.exp(-half) / math.gamma(power + 1) for power in powers)
        low, high = (middle, high) if tail > GATE_PROBABILITY else (low, middle)
    return middle


def fit_code(codes: Codes, site: int, reading: Reading) -> CodeFit:
    """Fit F of 1 - f0 / f = K F + e with R = diag(1 / inverse_variance + (eps K F)^2) + common_variance 11'.

    The F of the model error is that of a fit without it, held within the range, and three of its standard deviations: a
    light touch that the common mode makes look lighter would fail the gate.
    """
    (f0_hz, sensitivity), model_error, (low, high) = codes.sites[site], codes.model_error, codes.range_newton
    inverse_variance = reading.inverse_variance
    common_variance = reading.oscillator_variance + reading.common_mode_variance
    shift = [1.0 - f0 / f for f0, f in zip(f0_hz, reading.frequency_hz, strict=True)]
    weights, information, _ = _weights(sensitivity, inverse_variance, common_variance)
    first = sum(map(mul, weights, shift))
    force = low if first < low else high if first > high else first
    model_variance = model_error * model_error * (force * force + DOUBT_STD * DOUBT_STD / information)
    inverse = [i / (1.0 + i * model_variance * k * k) for i, k in zip(inverse_variance, sensitivity, strict=True)]
    weights, _, common = _weights(sensitivity, inverse, common_variance)
    force = sum(map(mul, weights, shift))
    within = low if force < low else high if force > high else force
    residual = [y - k * within for y, k in zip(shift, sensitivity, strict=True)]
    whitened = [i * r for i, r in zip(inverse, residual, strict=True)]
    total_whitened = sum(whitened)
    # R inverted by Sherman and Morrison.
    chi2 = sum(map(mul, whitened, residual)) - common * total_whitened * total_whitened
    log_det = math.log1p(common_variance * sum(inverse)) - sum([math.log(i) for i in inverse if i > 0.0])
    return CodeFit(site, force, chi2, chi2 + log_det, weights)


def _weights(
    sensitivity: list[float], inverse: list[float], common_variance: float
) -> tuple[list[float], float, float]:
    """Weights K'R^-1 / K'R^-1K for R = diag(1 / inverse) + v 11', K'R^-1K itself, and v / (1 + v 1'diag(inverse)1)."""
    common = common_variance / (1.0 + common_variance * sum(inverse))
    shared = common * sum(map(mul, inverse, sensitivity))
    whitened = [i * (k - shared) for i, k in zip(inverse, sensitivity, strict=True)]
    information = sum(map(mul, whitened, sensitivity))
    return [w / information for w in whitened], information, common


def uncertainty_newton(
    codes: Codes, site: int, force_newton: float, weights: list[float], reading: Reading
) -> tuple[float, float]:
    """Noise and systematic standard deviation of a force.

    Noise is that of counter and oscillator. Systematic are the error of K, independent from channel to channel, and
    the held common mode, which nearly cancels where signs of K are mixed.
    """
    common_gain = sum(weights) ** 2
    squares = [w * w for w in weights]
    noise = sum(map(mul, squares, reading.counter_variance)) + common_gain * reading.oscillator_variance
    spread = sum([w * k * k for w, k in zip(squares, codes.sites[site].sensitivity, strict=True)])
    systematic = (codes.model_error * force_newton) ** 2 * spread + common_gain * reading.common_mode_variance
    return math.sqrt(noise), math.sqrt(systematic)


class GroupSite(NamedTuple):
    """The site that explains a group of channels; the next best is worse by `gap` of the score.

    The fitted force is what noise may carry a little beyond the range.
    """

    fit: CodeFit
    gap: float

    @property
    def site(self) -> int:
        return self.fit.site


class Explanation(NamedTuple):
    """Explanation of a reading: `named` has one entry per site."""

    status: Literal["ok", "ambiguous", "rejected"]
    reason: Reason
    named: tuple[GroupSite, ...] = ()


class Groups(NamedTuple):
    """Channels in use, channels that no site explains, and groups that one site explains."""

    channels: Group
    unexplained: Group
    explained: Mapping[Group, GroupSite]


def detected_alone(codes: Codes, sites: Sequence[int], reading: Reading) -> dict[int, list[int]]:
    """Return by channel which sites it alone can follow with a force within the range."""
    gate = gates(len(reading.frequency_hz))[1]
    detected = {}
    for channel in reading.channels:
        alone = reading.on((channel,))
        detected[channel] = [site for site in sites if fit_code(codes, site, alone).chi2 <= gate]
    return detected


def explain_groups(codes: Codes, detected: Mapping[int, Sequence[int]], reading: Reading) -> Groups:
    """Find for every group of channels the site that explains it best, of those that each channel can follow."""
    gate = gates(len(reading.frequency_hz))
    explained = {}
    for group in chain.from_iterable(combinations(detected, size) for size in range(1, len(detected) + 1)):
        of_group = reading.on(group)
        sites = [site for site in detected[group[0]] if all(site in detected[channel] for channel in group)]
        fits = sorted([fit_code(codes, site, of_group) for site in sites], key=lambda fit: fit.score)
        if fits and fits[0].chi2 <= gate[len(group)]:
            gap = fits[1].score - fits[0].score if len(fits) > 1 else math.inf
            explained[group] = GroupSite(fits[0], gap)
    return Groups(tuple(detected), tuple(channel for channel, found in detected.items() if not found), explained)


@cache
def partitions(channels: Group) -> tuple[tuple[Group, ...], ...]:
    """Yield every partition of channels into groups."""
    if not channels:
        return ((),)
    first, rest = channels[0], channels[1:]
    companies = chain.from_iterable(combinations(rest, size) for size in range(len(rest) + 1))
    return tuple(
        ((first, *company), *others)
        for company in companies
        for others in partitions(tuple(c for c in rest if c not in company))
    )


def join(groups: Groups) -> Explanation:
    """Divide the channels among the fewest sites, two at least, that explain all of them.

    Every division into as many sites that explains them too, and every other site for one of the groups, must be worse
    by a gap of 13.8 in score.
    """
    explanations: list[tuple[int, float, list[GroupSite]]] = []
    for partition in partitions(groups.channels):
        named = [groups.explained[group] for group in partition if group in groups.explained]
        if len(named) == len(partition) == len({group.site for group in named}) > 1:
            explanations.append((len(named), sum(group.fit.score for group in named), named))
    if not explanations:
        return Explanation("rejected", _NO_SITE)
    explanations.sort(key=lambda explanation: explanation[:2])
    count, score, named = explanations[0]
    alike = [other for number, total, other in explanations if number == count and total - score < RUNNER_UP_GAP]
    if len(alike) > 1 or any(group.gap < RUNNER_UP_GAP for group in named):
        return Explanation(
            "ambiguous",
            Reason(ReasonCode.SITES_ALIKE, "channels detect different sites, and other sites explain them as well"),
        )
    return Explanation("ok", _SEVERAL, tuple(named))


def leave_one_out(groups: Groups) -> Explanation:
    """Name the site that explains all channels but one, which no site explains.

    A channel that follows another site is not left out here: `join` explains it, or nothing does.
    """
    rest = tuple(c for c in groups.channels if c not in groups.unexplained)
    if len(groups.channels) == LEAVE_ONE_OUT_CHANNELS and len(groups.unexplained) == 1 and rest in groups.explained:
        named = groups.explained[rest]
        if named.gap >= RUNNER_UP_GAP:
            why = Reason(ReasonCode.CHANNEL_LEFT_OUT, f"channel {groups.unexplained[0]} detects another tone")
            return Explanation("ok", why, (named,))
        return Explanation("ambiguous", SITES_ALIKE)
    return Explanation("rejected", _NO_SITE)
