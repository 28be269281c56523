"""Multi-touch on captured tones: groups of channels that follow different sites, fitted and combined."""

import math
from collections.abc import Mapping
from functools import cache
from itertools import chain, combinations
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.arrays import Floats
from resonator_daemon.forces.code_fit import RUNNER_UP_GAP, Channels, CodeFit, Codes, fit_codes, gates

LEAVE_ONE_OUT_CHANNELS: Final = 4  # with fewer, what is left is too little to convict a channel

Group = tuple[int, ...]  # of channels


class GroupSite(NamedTuple):
    """The site that explains a group of channels; `rival` is the next best, worse by `gap` of the score.

    `force_newton` is the fitted one, which noise may carry a little beyond the range; `weights` are (channels,).
    """

    site: int
    channels: Group
    force_newton: float
    chi2: float
    score: float
    weights: Floats
    rival: int
    gap: float


class Account(NamedTuple):
    """Explanation of a reading: `named` has one entry per site, `candidates` are the ambiguous ones."""

    status: Literal["ok", "ambiguous", "rejected"]
    reason: str
    named: tuple[GroupSite, ...] = ()
    candidates: tuple[int, ...] = ()


class Groups(NamedTuple):
    """Channels in use, channels that no site explains, and groups that one site explains."""

    channels: Group
    deaf: Group
    explained: Mapping[Group, GroupSite]


def detected_alone(codes: Codes, sites: NDArray[np.intp], reading: Channels) -> NDArray[np.bool_]:
    """Return which sites each channel alone can follow with a force within the range; (channels, p)."""
    channels = reading.frequency_hz.shape[1]
    used = np.flatnonzero(reading.used[0])
    rows, columns = (index.ravel() for index in np.indices((len(used), len(sites))))
    fit = _fit_groups(codes, sites[columns], reading, (np.arange(channels) == used[:, None])[rows])
    detected = np.zeros((channels, len(sites)), dtype=bool)
    detected[used] = (fit.chi2 <= gates(1)[1]).reshape(len(used), len(sites))
    return detected


def explain_groups(codes: Codes, sites: NDArray[np.intp], detected: NDArray[np.bool_], reading: Channels) -> Groups:
    """Find for every group of channels the site that explains it best, of those that each channel can follow."""
    used = tuple(int(c) for c in np.flatnonzero(reading.used[0]))
    groups, masks = _groups_of(used, len(detected))
    rows, columns = np.nonzero(~(masks[:, :, None] & ~detected).any(axis=1))
    fit = _fit_groups(codes, sites[columns], reading, masks[rows])
    gate = gates(len(detected))
    explained = {}
    for row in np.unique(rows):
        here = np.flatnonzero(rows == row)
        best, *rivals = here[np.argsort(fit.score[here])]
        group = groups[row]
        if fit.chi2[best] <= gate[len(group)]:
            explained[group] = GroupSite(
                int(sites[columns[best]]),
                group,
                float(fit.force_newton[best]),
                float(fit.chi2[best]),
                float(fit.score[best]),
                fit.weights[best],
                int(sites[columns[rivals[0]]]) if rivals else -1,
                float(fit.score[rivals[0]] - fit.score[best]) if rivals else math.inf,
            )
    return Groups(used, tuple(c for c in used if not detected[c].any()), explained)


@cache
def _groups_of(used: Group, channels: int) -> tuple[list[Group], NDArray[np.bool_]]:
    """Return all groups of the channels in use, and their channels as (groups, channels)."""
    groups = list(chain.from_iterable(combinations(used, size) for size in range(1, len(used) + 1)))
    return groups, np.array([[c in group for c in range(channels)] for group in groups])


def _fit_groups(codes: Codes, sites: NDArray[np.intp], reading: Channels, channels: NDArray[np.bool_]) -> CodeFit:
    """Fit p sites to one reading, each on its `channels` (p, channels)."""
    return fit_codes(
        codes,
        sites,
        np.broadcast_to(reading.frequency_hz, channels.shape),
        channels * reading.inverse_variance,
        np.broadcast_to(reading.common_variance, len(sites)),
    )


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


def join(groups: Groups) -> Account:
    """Divide the channels among the fewest sites, two at least, that explain all of them.

    Every division into as many sites that explains them too, and every other site for one of the groups, must be worse
    by a gap of 13.8 in score.
    """
    accounts = []
    for partition in partitions(groups.channels):
        named = [groups.explained[group] for group in partition if group in groups.explained]
        if len(named) == len(partition) == len({group.site for group in named}) > 1:
            accounts.append((len(named), sum(group.score for group in named), named))
    if not accounts:
        return Account("rejected", "no site explains the channels")
    accounts.sort(key=lambda account: account[:2])
    count, score, named = accounts[0]
    alike = [other for number, total, other in accounts if number == count and total - score < RUNNER_UP_GAP]
    rivals = {group.rival for group in named if group.gap < RUNNER_UP_GAP}
    if len(alike) > 1 or rivals:
        candidates = rivals.union(group.site for other in alike for group in other)
        return Account("ambiguous", "channels hear different sites, and not these alone", (), tuple(sorted(candidates)))
    return Account("ok", "channels hear different sites", tuple(named))


def leave_one_out(groups: Groups) -> Account:
    """Name the site that explains all channels but one, which no site explains.

    A channel that follows another site is not left out here: `join` explains it, or nothing does.
    """
    rest = tuple(c for c in groups.channels if c not in groups.deaf)
    if len(groups.channels) == LEAVE_ONE_OUT_CHANNELS and len(groups.deaf) == 1 and rest in groups.explained:
        named = groups.explained[rest]
        if named.gap >= RUNNER_UP_GAP:
            return Account("ok", f"channel {groups.deaf[0]} hears another tone", (named,))
        return Account(
            "ambiguous", "two sites explain the channels alike", (), tuple(sorted((named.site, named.rival)))
        )
    return Account("rejected", "no site explains the channels")
