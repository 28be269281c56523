"""Scenarios: what every touch of a plate does at any moment, and how warm it is around."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from resonator_daemon.base.plate import Plate
from simulators.arrays import Floats
from simulators.faults import FaultPlan
from simulators.physics import Physics
from simulators.plate import Contact
from simulators.presses import Presses
from simulators.pressing import FRICTION_COEFFICIENT, RADIUS_M_AT_1_NEWTON, Pressing, joined
from simulators.scenario_file import ScenarioFile, TimedKelvin, Touch, reach_m, read_scenario, site_at

_EMPTY = ScenarioFile()  # its defaults
_ROUNDING = 1e-6  # relative: until a touch is surely over, whatever rounding does
_SHORTEST_RAMP_S = 1e-9  # stands for an instant


class Scenario:
    """The touches of a scenario on one plate, or those of clients; time counts from the first frame.

    `presses` are what clients hold: it alone presses at all moments that are asked for while it is held.
    """

    def __init__(
        self,
        touches: Sequence[Touch],
        period_s: float | None,
        plate: Plate,
        *,
        physics: Physics = _EMPTY.plate,
        environment_kelvin: Sequence[TimedKelvin] = _EMPTY.environment_kelvin,
        seed: int = _EMPTY.seed,
        faults: FaultPlan = _EMPTY.faults,
        world: Mapping[str, float | str] = _EMPTY.world,
        presses: Presses | None = None,
    ) -> None:
        self.physics = physics
        self.seed = seed
        self.faults = faults
        self.world = world
        self._presses = presses
        self.positions_m = np.array([_start_m(touch, plate) for touch in touches]).reshape(-1, 2)
        self.whole_plate = np.array([touch.whole_plate for touch in touches], dtype=np.bool_)
        self._radius_m = np.full(len(touches), RADIUS_M_AT_1_NEWTON)
        self._friction = np.full(len(touches), FRICTION_COEFFICIENT)
        self.peak_newton = np.array([touch.force_newton for touch in touches])
        slides = np.array([touch.to_mm is not None for touch in touches], dtype=np.bool_)
        ends_m = np.array([touch.to_mm or (0.0, 0.0) for touch in touches]).reshape(-1, 2) * 1e-3
        self._path_m = np.where(slides[:, np.newaxis], ends_m - self.positions_m, 0.0)
        self._sites = list(zip(plate.site_ids.tolist(), map(tuple, plate.site_positions_m.tolist()), strict=True))
        places_m = [*self.positions_m, *(self.positions_m + self._path_m)]
        self._site_by_place = {tuple(place.tolist()): site_at(place, plate) for place in places_m}
        self._kelvin = np.array([np.nan if touch.kelvin is None else touch.kelvin for touch in touches])
        self._environment_s, self._environment_kelvin = np.array(environment_kelvin).T
        contacts = np.where(self.whole_plate, len(plate.site_ids), 1)
        self._first_ids = 1 + np.cumsum(contacts) - contacts
        self._ids_per_round = int(contacts.sum())
        self._period_s = period_s
        self._start_s = np.array([touch.start_s for touch in touches])
        self._rise_s = np.array([max(touch.rise_s, _SHORTEST_RAMP_S) for touch in touches])
        self._hold_s = np.array([max(touch.hold_s, _SHORTEST_RAMP_S) for touch in touches])
        self._fall_s = np.array([max(touch.fall_s, _SHORTEST_RAMP_S) for touch in touches])
        self._duration_s = (self._rise_s + self._hold_s + self._fall_s) * (1.0 + _ROUNDING)
        self._shear_peak = np.array([touch.shear.peak_ratio if touch.shear else 0.0 for touch in touches])
        directions = np.radians([touch.shear.direction_deg if touch.shear else 0.0 for touch in touches])
        self._shear_direction = np.stack([np.cos(directions), np.sin(directions)], axis=-1)

    @property
    def fixed(self) -> bool:
        """Whether nothing but time decides what presses: there are no clients."""
        return self._presses is None

    def at(self, times_s: Floats) -> Pressing:
        """Return what every touch does at times (n,)."""
        since_s = times_s[:, np.newaxis] - self._start_s
        round_number = np.zeros_like(since_s)
        if self._period_s is not None:
            round_number = np.maximum(np.floor(since_s / self._period_s), 0.0)
            since_s = since_s - round_number * self._period_s
        force_newton = np.zeros((*since_s.shape, 3))
        active = np.flatnonzero(((since_s > 0.0) & (since_s < self._duration_s)).any(axis=0))
        if len(active):
            force_newton[:, active] = self._force_newton(since_s[:, active], active)
        position_m = np.broadcast_to(self.positions_m, (*since_s.shape, 2))
        kelvin = np.broadcast_to(np.nan, since_s.shape)
        if self._path_m.any():
            position_m = self.positions_m + self._held(since_s)[..., np.newaxis] * self._path_m
        if not np.isnan(self._kelvin).all():
            kelvin = np.where(force_newton[..., 2] > 0.0, self._kelvin, np.nan)
        ids = self._first_ids + round_number.astype(np.int64) * self._ids_per_round
        pressing = Pressing(ids, force_newton, position_m, kelvin, self.whole_plate, self._radius_m, self._friction)
        if self._presses is None:
            return pressing
        if self._presses.held:
            pressing = pressing._replace(force_newton=np.zeros_like(force_newton))
        return joined(pressing, self._presses.at(len(times_s)))

    def _force_newton(self, since_s: Floats, touch: npt.NDArray[np.intp]) -> Floats:
        """Return the force (n, k, 3) of touches (k,) at times (n, k) since their start."""
        rise = _ramp(since_s / self._rise_s[touch])
        fall = _ramp((since_s - self._rise_s[touch] - self._hold_s[touch]) / self._fall_s[touch])
        force_newton = np.zeros((*since_s.shape, 3))
        force_newton[..., 2] = normal = self.peak_newton[touch] * rise * (1.0 - fall)
        if self._shear_peak[touch].any():
            # A ramp up and down again over the hold is the square of a sine.
            ratio = self._shear_peak[touch] * np.sin(np.pi * self._held(since_s, touch)) ** 2
            tangential = ratio * FRICTION_COEFFICIENT * normal
            force_newton[..., :2] = tangential[..., np.newaxis] * self._shear_direction[touch]
        return force_newton

    def _held(self, since_s: Floats, touch: npt.NDArray[np.intp] | slice = slice(None)) -> Floats:
        """Return which share of their holds has passed for touches (k,) at times (n, k) since their start."""
        held: Floats = np.minimum(np.maximum((since_s - self._rise_s[touch]) / self._hold_s[touch], 0.0), 1.0)
        return held

    def contacts(self, pressing: Pressing) -> list[list[Contact]]:
        """Return what touches at each of the moments of `pressing`.

        A touch of the whole plate is a contact per site. One that slides is on a site at the ends of its way alone.
        """
        contacts: list[list[Contact]] = [[] for _ in pressing.ids]
        pressed = pressing.force_newton[..., 2] != 0.0
        moments, touches = (index.tolist() for index in np.nonzero(pressed))
        ids, forces = pressing.ids[pressed].tolist(), pressing.force_newton[pressed].tolist()
        positions = pressing.position_m[pressed].tolist()
        for moment, touch, contact_id, force, position in zip(moments, touches, ids, forces, positions, strict=True):
            force_newton, position_m = tuple(force), tuple(position)
            if pressing.whole_plate[touch]:
                contacts[moment] += [
                    Contact(contact_id + site, site_id, site_m, force_newton)
                    for site, (site_id, site_m) in enumerate(self._sites)
                ]
                continue
            contacts[moment].append(Contact(contact_id, self._site_id(position_m), position_m, force_newton))
        return contacts

    def _site_id(self, position_m: tuple[float, float]) -> int | None:
        site_id = self._site_by_place.get(position_m)
        return site_id if site_id is not None or self._presses is None else self._presses.site_at(position_m)

    def environment_kelvin(self, times_s: Floats) -> Floats:
        """Return the temperature around the plate at times (n,)."""
        if len(self._environment_kelvin) == 1:
            return np.full(times_s.shape, self._environment_kelvin[0])
        kelvin: Floats = np.interp(times_s, self._environment_s, self._environment_kelvin)
        return kelvin


def load_scenario(name_or_path: str, plate: Plate, presses: Presses | None = None) -> Scenario:
    """Load a shipped scenario by its name, or a scenario file by its path; raises as `read_scenario`."""
    file = read_scenario(name_or_path, plate)
    return Scenario(
        file.touches,
        file.period_s,
        plate,
        physics=file.plate,
        environment_kelvin=file.environment_kelvin,
        seed=file.seed,
        faults=file.faults,
        world=file.world,
        presses=presses,
    )


def _start_m(touch: Touch, plate: Plate) -> Floats:
    low_m, high_m = reach_m(plate)
    position_m: Floats = (low_m + high_m) / 2.0
    if touch.site is not None:
        position_m = plate.site_positions_m[plate.site_ids.tolist().index(touch.site)]
    elif touch.position_mm is not None:
        position_m = np.multiply(touch.position_mm, 1e-3)
    return position_m


def _ramp(progress: Floats) -> Floats:
    """Rise from 0 to 1 as a raised cosine while progress goes from 0 to 1."""
    ramp: Floats = 0.5 - 0.5 * np.cos(np.pi * np.minimum(np.maximum(progress, 0.0), 1.0))
    return ramp
