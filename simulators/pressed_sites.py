"""The force sites of a plate under a scenario: what loads them gate by gate, and the frequencies they sound at."""

from typing import NamedTuple

import numpy as np

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from simulators.arrays import Floats
from simulators.load_sharing import site_loads
from simulators.plate import Contact, gate_middles_s
from simulators.scenario import Scenario
from simulators.site_physics import SiteFrames, SitePhysics


class PressedGates(NamedTuple):
    """n gates of the sites, in the order of the plate's site_ids."""

    force_newton: Floats  # (n, sites)
    frequency_hz: Floats  # (n, sites, channels), mean over the gate
    sites: SiteFrames
    contacts: list[list[Contact]]  # of each gate


class PressedSites:
    """Sites that sound at f0 (1 + y)/(1 - K F), F and y with the imperfections of the scenario's physics.

    Physics do not go on while nobody counts.
    """

    def __init__(self, plate: Plate, scenario: Scenario, random: np.random.Generator) -> None:
        tones = plate.tones
        (force,) = np.nonzero(tones.signal_index == plate.signals.index(FORCE_SIGNAL))
        by_site = force[np.argsort(tones.site_index[force])]
        self._f0_hz = tones.f0_hz[by_site]
        self._sensitivity = tones.sensitivity[by_site]
        self._plate = plate
        self._scenario = scenario
        self._physics = SitePhysics(plate, scenario.physics, random)
        self._tick_rate_hz = plate.counter.reference_hz * (1.0 + scenario.physics.reference_error)

    def advance(self, scenario_ticks: int, gate_ticks: int, frames: int) -> PressedGates:
        """Go on by some gates, the first of which starts so many ticks after the scenario began."""
        times_s = gate_middles_s(scenario_ticks, gate_ticks, frames, self._tick_rate_hz)
        pressing = self._scenario.at(times_s)
        loads = site_loads(pressing, self._plate)
        kelvin = self._scenario.environment_kelvin(times_s)
        sites = self._physics.advance(gate_ticks / self._tick_rate_hz, *loads, kelvin)
        shift = self._sensitivity * sites.sensitivity_factor * sites.felt_newton[..., np.newaxis]
        frequency_hz = self._f0_hz * (1.0 + sites.relative_shift[:, :-1, np.newaxis]) / (1.0 - shift)
        return PressedGates(loads.force_newton, frequency_hz, sites, self._scenario.contacts(pressing))
