"""Presses that last for minutes, and plates that warm up: effect of drift on forces and untouched plates."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from plate_bench import ROOM_KELVIN, SETTLED_S, PlateBench

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.forces.contacts import Touch as TrackedTouch
from resonator_daemon.estimate.forces.site_identification import SiteForce
from simulators.physics import Physics
from simulators.scenario_file import Touch

HELD_NEWTON = 2.0
SWING_KELVIN = 2.0
SWING_S = 800.0  # one period: after ten minutes it is as cold as it gets
SETTLE_S = 5.0  # before the press
RAMP_S = 0.15
END_S = 10.0  # the mean error of the end is over that long
SHOCK_KELVIN, SHOCK_S = 10.0, 5.0


class Held(NamedTuple):
    """Errors of a constant force, in newtons."""

    known: float  # share of the readings with a force
    end_newton: float  # mean over the last 10 s
    covered: float  # share within two stated standard deviations


def hold(plate: Plate, physics: Physics, site: int, seconds: float, *, seed: int = 1) -> tuple[Held, Held]:
    """Hold 2 N on a site while the room swings by 2 K to both sides: the site's own force, and that of its contact.

    Under a cover the contact's force is that of a fit to all sites.
    """
    touch = Touch(start_s=SETTLE_S, site=site, force_newton=HELD_NEWTON, rise_s=RAMP_S, hold_s=seconds, fall_s=RAMP_S)
    room = [
        (float(t), ROOM_KELVIN + SWING_KELVIN * math.sin(2.0 * math.pi * t / SWING_S))
        for t in np.arange(0.0, SETTLE_S + seconds + 10.0, 5.0)
    ]
    window_ms = _window_ms(plate)
    bench = PlateBench(
        plate, [touch], physics=physics, environment_kelvin=room, seed=seed, window_ms=window_ms, step_ms=window_ms
    )
    own, contacts = [], []
    for moment in bench.play(SETTLE_S + RAMP_S + seconds):
        if moment.true_newton.get(1, 0.0) > HELD_NEWTON * (1.0 - 1e-9):
            index = bench.site_ids.index(site)
            own.append(_of_site(moment.reading.sites, index))
            contacts.append(_of_site([contact.touch for contact in moment.reading.contacts], index))
    last = round(END_S * 1e3 / window_ms)
    return _held(np.array(own), last), _held(np.array(contacts), last)


def _window_ms(plate: Plate) -> float:
    """Return the shortest window that a plate with gates as long as these allows."""
    frame_ms = 1e3 / plate.counter.frame_rate_hz
    return 2.0 * frame_ms if plate.counter.kind == "single-tone" else frame_ms


def _of_site(forces: Sequence[SiteForce] | Sequence[TrackedTouch], site: int) -> tuple[float, float, float]:
    for force in forces:
        if force.site == site:
            return force.force_newton, force.noise_newton, force.systematic_newton
    return (math.nan,) * 3


def _held(rows: Floats, last: int) -> Held:
    """`rows` (n, 3) are force, noise and systematic in newtons, the `last` ones those of the end."""
    known = np.isfinite(rows).all(axis=1)
    error, stated = rows[known, 0] - HELD_NEWTON, np.hypot(rows[known, 1], rows[known, 2])
    return Held(float(known.mean()), float(error[-last:].mean()), float(np.mean(np.abs(error) <= 2.0 * stated)))


def contacts_of_a_shock(plate: Plate, *, seed: int = 1) -> int:
    """Return the number of contacts of an untouched plate while the room warms by 10 K within 5 s."""
    room = [(0.0, ROOM_KELVIN), (SETTLE_S, ROOM_KELVIN), (SETTLE_S + SHOCK_S, ROOM_KELVIN + SHOCK_KELVIN)]
    step_ms = max(5.0, _window_ms(plate))
    bench = PlateBench(
        plate, [], environment_kelvin=room, seed=seed, window_ms=max(10.0, _window_ms(plate)), step_ms=step_ms
    )
    return sum(
        event.event == "onset" for moment in bench.play(SETTLE_S + 3.0 * SHOCK_S) for event in moment.reading.events
    )


def sites_of_a_whole_press(plate: Plate, hold_s: float) -> int:
    """Return the largest number of sites in a reading while 2 N press on each of them."""
    touch = Touch(start_s=SETTLED_S, whole_plate=True, force_newton=HELD_NEWTON, hold_s=hold_s)
    bench = PlateBench(plate, [touch], seed=1)
    return max(len(moment.reading.sites) for moment in bench.play(SETTLED_S + touch.duration_s))
