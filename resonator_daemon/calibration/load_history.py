"""History of the loads on each site, from the readings: steps and readings for a fit of loads."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from resonator_daemon.calibration.load_procedure import Loading, LoadProcedure
from resonator_daemon.calibration.steps import LoadRequest
from resonator_daemon.forces.loadings import Readings, Steps

COMMON_MODE_STD: Final = 1e-9  # of the pilot's mean over some tenths of a second


class LoadChange(NamedTuple):
    """A load that comes to a site, or goes: then `loading` is None."""

    site: int
    since_s: float
    kelvin: float
    loading: Loading | None


def load_history(procedure: LoadProcedure, loadings: Sequence[Loading]) -> list[LoadChange]:
    """Return the changes that loadings were, in their order."""
    changes = []
    for loading in sorted(loadings, key=lambda loading: loading.since_s):
        kelvin = loading.step.kelvin
        changes.append(LoadChange(loading.site, loading.since_s, kelvin, loading))
        if (released_s := _released_s(procedure, loading)) is not None:
            changes.append(LoadChange(loading.site, released_s, kelvin, None))
    return changes


def steps_of(changes: Sequence[LoadChange], request: LoadRequest) -> Steps:
    """Return the changes as the steps of a fit."""
    masses_kg = np.array(request.masses_kg)
    lying_kg = [change.loading.step.mass_kg if change.loading else math.nan for change in changes]
    kelvin = [change.kelvin if request.kelvin is not None else math.nan for change in changes]
    return Steps(
        np.array([change.site for change in changes]),
        np.array([change.since_s for change in changes]),
        masses_kg == np.array(lying_kg)[:, None],
        np.full(len(changes), COMMON_MODE_STD),
        np.array(kelvin),
    )


def readings_of(changes: Sequence[LoadChange], procedure: LoadProcedure) -> Readings:
    """Return the readings of all loads that were captured."""
    captured = [(row, change.loading) for row, change in enumerate(changes) if change.loading is not None]
    return Readings(
        np.concatenate([np.full(len(load.times_s), row) for row, load in captured]),
        np.concatenate([load.times_s for _, load in captured]),
        np.concatenate([load.without_common_mode(procedure.untouched) for _, load in captured]),
        np.concatenate([load.std for _, load in captured]),
        np.concatenate([np.full(len(load.times_s), load.oscillator_std) for _, load in captured]),
    )


def _released_s(procedure: LoadProcedure, loading: Loading) -> float | None:
    """When a load was taken away; None where another followed on the same site."""
    after = [time_s for time_s in procedure.released_s if time_s > loading.times_s[-1]]
    following = [other.since_s for other in procedure.loadings.values() if other.since_s > loading.since_s]
    if not after or (following and min(following) < after[0]):
        return None
    return after[0]
