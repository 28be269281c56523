"""Two touches at once on emulated plates: the identified sites, and the status `possibly_more`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from plate_bench import SETTLED_S, Moment, PlateBench, corner_levels_db

from resonator_daemon.base.plate import Plate
from simulators.scenario_file import Touch

FORCE_NEWTON = (0.2, 8.0)
APART_M = 5e-3
RAMP_S = 0.05
HOLD_S = (0.08, 0.16)
ONSETS_APART_S = 0.1
GAP_S = 0.05
JOINT_NEWTON = 0.1  # of each touch, averaged over a window, before a reading is expected to have both
TAKEOVER_DB = 1.0  # by which a tone has to be stronger than the counted one to be counted at a corner


class Pair(NamedTuple):
    """Readings of one pair; `joint` are those while both pressed."""

    separable: bool  # each touch is the strongest tone, by 1 dB, at some corner
    wrong: int  # readings, at any time, with another site
    joint: int
    both: int  # of the joint ones, with both sites
    more: int  # of the joint ones, with `possibly_more`
    apart_m: list[float]  # of each touch from the nearest contact, if both sites were identified


def play_pairs(plate: Plate, count: int) -> list[Pair]:
    """Play pairs of touches on sites 5 mm apart or more, which begin up to 0.1 s and end up to 0.2 s apart."""
    random = np.random.default_rng([1, 0])
    seed = int(random.integers(2**31))
    every_s = ONSETS_APART_S + 2 * RAMP_S + HOLD_S[1] + GAP_S
    touches = [touch for index in range(count) for touch in _draw(plate, SETTLED_S + index * every_s, random)]
    bench = PlateBench(plate, touches, seed=seed)
    moments: list[list[Moment]] = [[] for _ in range(count)]
    for moment in bench.play(SETTLED_S + count * every_s):
        if moment.true_newton:
            moments[(min(moment.true_newton) - 1) // 2].append(moment)
    corners = _corners(plate, seed)
    return [_outcome(bench, touches[2 * n : 2 * n + 2], seen, corners) for n, seen in enumerate(moments)]


def _draw(plate: Plate, start_s: float, random: np.random.Generator) -> list[Touch]:
    while True:
        first, second = random.choice(len(plate.site_ids), 2, replace=False)
        if np.linalg.norm(plate.site_positions_m[first] - plate.site_positions_m[second]) >= APART_M:
            break
    return [
        Touch(
            start_s=start_s + late_s,
            site=int(plate.site_ids[site]),
            force_newton=random.uniform(*FORCE_NEWTON),
            rise_s=RAMP_S,
            hold_s=random.uniform(*HOLD_S),
            fall_s=RAMP_S,
        )
        for site, late_s in ((first, 0.0), (second, random.uniform(0.0, ONSETS_APART_S)))
    ]


def _corners(plate: Plate, seed: int) -> NDArray[np.int64]:
    """At how many corners (sites, sites) the first site is the stronger one; of a comb, at all for both."""
    if plate.counter.kind != "single-tone":
        return np.full((len(plate.site_ids),) * 2, len(plate.transducers_m))
    level_db = corner_levels_db(plate, seed)
    stronger: NDArray[np.int64] = np.count_nonzero(level_db[:, None] - level_db > TAKEOVER_DB, axis=2)
    return stronger


def _outcome(bench: PlateBench, touches: Sequence[Touch], seen: Sequence[Moment], corners: NDArray[np.int64]) -> Pair:
    sites = [touch.site for touch in touches if touch.site is not None]
    first, second = map(bench.site_ids.index, sites)
    strengths = int(corners[first, second]), int(corners[second, first])
    named = [bench.named_sites(moment.reading) for moment in seen]
    pressing = [sum(newton > JOINT_NEWTON for newton in moment.true_newton.values()) == 2 for moment in seen]
    joint = [(moment, here) for moment, here, both in zip(seen, named, pressing, strict=True) if both]
    return Pair(
        min(strengths) > 0,
        sum(not here <= set(moment.true_site.values()) for moment, here in zip(seen, named, strict=True)),
        len(joint),
        sum(here >= set(sites) for _, here in joint),
        sum(moment.reading.status == "possibly_more" for moment, _ in joint),
        [apart for moment, here in joint if here >= set(sites) for apart in _apart_m(moment)],
    )


def _apart_m(moment: Moment) -> list[float]:
    """Distance of each touch from the nearest contact."""
    places = np.array([contact.touch.position_m for contact in moment.reading.contacts])
    true = np.array(list(moment.true_position_m.values()))
    apart: list[float] = np.linalg.norm(places[:, None] - true, axis=2).min(axis=0).tolist()
    return apart
