"""Multi-touch on captured tones: groups of channels that follow different sites, fitted and combined."""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import chain, combinations
from typing import Final, Literal, NamedTuple

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.forces.code_fit import RUNNER_UP_GAP, CodeFit, Codes, Reading, fit_code, gates

LEAVE_ONE_OUT_CHANNELS: Final = 4  # with fewer, what is left is too little to convict a channel
SITES_ALIKE: Final = Reason(ReasonCode.SITES_ALIKE, "two sites explain the channels alike")
_NO_SITE: Final = Reason(ReasonCode.NO_SITE_FITS, "no site explains the channels")
_SEVERAL: Final = Reason(ReasonCode.SEVERAL_SITES, "channels detect different sites")

Group = tuple[int, ...]  # of channels


class GroupSite(NamedTuple):
    """The site that explains a group of channels; `rival` is the next best, worse by `gap` of the score.

    The fitted force is what noise may carry a little beyond the range.
    """

    fit: CodeFit
    rival: int
    gap: float

    @property
    def site(self) -> int:
        return self.fit.site


class Explanation(NamedTuple):
    """Explanation of a reading: `named` has one entry per site, `candidates` are the ambiguous ones."""

    status: Literal["ok", "ambiguous", "rejected"]
    reason: Reason
    named: tuple[GroupSite, ...] = ()
    candidates: tuple[int, ...] = ()


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
        together = reading.on(group)
        sites = [site for site in detected[group[0]] if all(site in detected[channel] for channel in group)]
        fits = sorted([fit_code(codes, site, together) for site in sites], key=lambda fit: fit.score)
        if fits and fits[0].chi2 <= gate[len(group)]:
            rival, gap = (fits[1].site, fits[1].score - fits[0].score) if len(fits) > 1 else (-1, math.inf)
            explained[group] = GroupSite(fits[0], rival, gap)
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
    rivals = {group.rival for group in named if group.gap < RUNNER_UP_GAP}
    if len(alike) > 1 or rivals:
        candidates = rivals.union(group.site for other in alike for group in other)
        return Explanation(
            "ambiguous",
            Reason(ReasonCode.SITES_ALIKE, "channels detect different sites, and other sites explain them as well"),
            (),
            tuple(sorted(candidates)),
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
        return Explanation("ambiguous", SITES_ALIKE, (), tuple(sorted((named.site, named.rival))))
    return Explanation("rejected", _NO_SITE)
