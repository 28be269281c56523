"""Single touches on an emulated quartz16: sites, force errors and stated uncertainties."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from plate_bench import ROOM_KELVIN, SETTLED_S, PlateBench

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.base.plate_tables import Response, Thermal
from simulators.physics import Physics
from simulators.scenario_file import Touch

FORCE_NEWTON = (0.2, 8.0)
COUNTED_SHARE = 0.05  # of its peak, before a touch's force counts
HYSTERESIS_FRACTION, CREEP_FRACTION, CREEP_TIME_S = 0.01, 0.005, 20.0
CONTACT_STD_KELVIN = 3.0
WARM_KELVIN = 305.0
WARMTH = Physics(
    ideal=True,
    temperature_coefficient=Physics().temperature_coefficient,
    temperature_coefficient_std=Physics().temperature_coefficient_std,
    temperature_quadratic=Physics().temperature_quadratic,
    temperature_cubic=Physics().temperature_cubic,
    temperature_transient_s=Physics().temperature_transient_s,
)
AFTER_S = 0.05


class Errors(NamedTuple):
    """n readings of forces: `rows` (n, 5) are the touch and, in newtons, truth, error, stated noise and systematic."""

    rows: Floats

    @property
    def of_touches(self) -> "Errors":
        """Of each touch the reading in the middle, where its force rests."""
        _, first, count = np.unique(self.rows[:, 0], return_index=True, return_counts=True)
        return Errors(self.rows[first + count // 2])

    @property
    def rms_newton(self) -> float:
        return rms(self.rows[:, 2])

    @property
    def stated_newton(self) -> float:
        """Noise and systematic together."""
        return rms(np.hypot(self.rows[:, 3], self.rows[:, 4]))

    @property
    def worst_ratio(self) -> float:
        """Largest ratio of an error to its stated uncertainty."""
        return float(np.max(np.abs(self.rows[:, 2]) / np.hypot(self.rows[:, 3], self.rows[:, 4])))

    @property
    def covered(self) -> float:
        """Share of the errors that two standard deviations cover."""
        return float(np.mean(np.abs(self.rows[:, 2]) <= 2.0 * np.hypot(self.rows[:, 3], self.rows[:, 4])))


class Played(NamedTuple):
    """Readings of touches, one at a time."""

    touches: int
    found: int  # touches whose site was identified
    wrong: int  # readings with another one
    more: int  # touches with the status `possibly_more` at any time
    errors: Errors


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def draw_touches(
    plate: Plate,
    random: np.random.Generator,
    count: int,
    *,
    ramp_s: float = 0.15,
    hold_s: float = 0.5,
    gap_s: float = 0.1,
    kelvin_std: float = 0.0,
) -> list[Touch]:
    """Touches on random sites one after the other, their forces spread evenly over the logarithm."""
    low, high = np.log(FORCE_NEWTON).tolist()
    forces = np.exp(random.uniform(low, high, count))
    sites = random.choice(plate.site_ids, count)
    kelvin = ROOM_KELVIN + kelvin_std * random.standard_normal(count)
    every_s = 2.0 * ramp_s + hold_s + gap_s
    return [
        Touch(
            start_s=SETTLED_S + index * every_s,
            site=int(sites[index]),
            force_newton=float(forces[index]),
            rise_s=ramp_s,
            hold_s=hold_s,
            fall_s=ramp_s,
            kelvin=float(kelvin[index]) if kelvin_std else None,
        )
        for index in range(count)
    ]


def play(bench: PlateBench, touches: Sequence[Touch]) -> Played:
    """Play touches of which no two overlap, to the end."""
    found, more, wrong = set[int](), set[int](), 0
    rows: list[tuple[float, ...]] = []
    for moment in bench.play(max(touch.start_s + touch.duration_s for touch in touches) + AFTER_S):
        reading = moment.reading
        named = bench.named_sites(reading)
        wrong += not named <= set(moment.true_site.values())
        found |= {contact for contact, site in moment.true_site.items() if site in named}
        for contact, newton in moment.true_newton.items():
            touch = touches[contact - 1]
            more |= {contact} if reading.status == "possibly_more" else set()
            if reading.at_step and newton > COUNTED_SHARE * touch.force_newton:
                rows += [
                    (contact, newton, force.force_newton - newton, force.noise_newton, force.systematic_newton)
                    for force in reading.sites
                    if bench.site_ids[force.site] == touch.site and np.isfinite(force.force_newton)
                ]
    return Played(len(touches), len(found), wrong, len(more), Errors(np.array(rows).reshape(-1, 5)))


def ideal_touches(count: int, seed: int = 1) -> Played:
    return _touches(load_plate("quartz16"), Physics(ideal=True), count, seed)


def creeping_touches(count: int, *, configured: bool, seed: int = 1) -> Played:
    plate = load_plate("quartz16")
    if configured:
        plate = plate.model_copy(update={"response": _response(creep_fraction=CREEP_FRACTION)})
    return _touches(plate, Physics(ideal=True, creep_fraction=CREEP_FRACTION), count, seed)


def hysteretic_touches(count: int, *, configured: bool, seed: int = 1) -> Played:
    plate = load_plate("quartz16")
    if configured:
        newton = HYSTERESIS_FRACTION * plate.force_max_newton
        plate = plate.model_copy(update={"response": _response(hysteresis_newton=newton)})
    return _touches(plate, Physics(ideal=True, hysteresis_fraction=HYSTERESIS_FRACTION), count, seed)


def warm_touches(holds_s: Sequence[float], frame_rate_hz: float, seed: int = 1) -> Played:
    """Warm fingers on all sites one after the other, 1 N and 4 N; only the temperature disturbs."""
    plate = load_plate("quartz16")
    thermal = Thermal(contact_std_kelvin=WARM_KELVIN - ROOM_KELVIN)
    counter = plate.counter.model_copy(update={"frame_rate_hz": frame_rate_hz})
    plate = plate.model_copy(update={"thermal": thermal, "counter": counter})
    plate = _with_coefficients(plate, np.random.default_rng(seed))
    touches, start_s = [], SETTLED_S + 1.0
    for order, site in enumerate(plate.site_ids.tolist()):
        newton, hold_s = (1.0, 4.0)[order % 2], holds_s[order // 2 % len(holds_s)]
        touch = Touch(start_s=start_s, site=site, force_newton=newton, hold_s=hold_s, kelvin=WARM_KELVIN)
        touches.append(touch)
        start_s += touch.duration_s + 1.0
    window_ms = 2e3 / frame_rate_hz
    return play(PlateBench(plate, touches, physics=WARMTH, seed=seed, window_ms=window_ms, step_ms=window_ms), touches)


def _with_coefficients(plate: Plate, random: np.random.Generator) -> Plate:
    table = plate.model_dump(exclude_none=True)
    for site in table["sites"]:
        a = random.normal(WARMTH.temperature_coefficient, WARMTH.temperature_coefficient_std)
        coefficients = (a, WARMTH.temperature_quadratic, WARMTH.temperature_cubic)
        site["tones"][0]["temperature_coefficients"] = coefficients
    return Plate.model_validate(table)


def short_touches(count: int, seed: int = 1) -> Played:
    """Short touches on plates with every imperfection, some warm or cold; the plate file describes them."""
    plate = described_plate("quartz16")
    random = np.random.default_rng([seed, 0])
    short = {"ramp_s": 0.03, "hold_s": 0.07, "gap_s": 0.03, "kelvin_std": CONTACT_STD_KELVIN}
    touches = draw_touches(plate, random, count, **short)
    return play(PlateBench(plate, touches, seed=int(random.integers(2**31))), touches)


def described_plate(name: str) -> Plate:
    """Return the plate whose file has the response and the warm touches of the emulated one."""
    plate = load_plate(name)
    physics = Physics()
    newton = physics.hysteresis_fraction * plate.force_max_newton
    response = _response(newton, physics.creep_fraction)
    thermal = Thermal(contact_std_kelvin=CONTACT_STD_KELVIN)
    return plate.model_copy(update={"response": response, "thermal": thermal})


def _response(hysteresis_newton: float = 0.0, creep_fraction: float = 0.0) -> Response:
    return Response(hysteresis_newton=hysteresis_newton, creep_fraction=creep_fraction, creep_time_s=CREEP_TIME_S)


def _touches(plate: Plate, physics: Physics, count: int, seed: int) -> Played:
    touches = draw_touches(plate, np.random.default_rng(seed), count)
    return play(PlateBench(plate, touches, physics=physics, seed=seed), touches)
