"""Forces, sites and uncertainties from end to end: emulated plates counted straight into the daemon's chain.

Truth is the emulator's, which shares no formula with the chain.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from plates import with_counter

from firmware_protocol.layouts import TONE_FIELDS
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.base.plate_tables import Response, Thermal
from resonator_daemon.board.config.tables import Measurement
from resonator_daemon.board.session.compatibility import gate_ticks, oscillator_hz
from resonator_daemon.estimate.forces.readings import ForceReading
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.measure.sensors.force_sensor import ForceSensor
from resonator_daemon.measure.sensors.single_tone_processing import SingleToneProcessing
from simulators.comb_plate import CombPlate
from simulators.physics import Physics
from simulators.plate import CountedFrame
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import Scenario
from simulators.scenario_file import Touch

ROOM_KELVIN = 298.15
SETTLED_S = 0.4  # from the first frame on until the sensor knows its baseline
BLOCK_FRAMES = 40

_TONE = np.dtype([(field.name, "<" + field.code) for field in TONE_FIELDS])


class Moment(NamedTuple):
    """A reading, and by contact the true force averaged over its window, its site's id and its position."""

    reading: ForceReading
    named: set[int]  # ids of the sites where the reading says that something presses, or that a contact began
    newton: dict[int, float]
    site: dict[int, int | None]
    position_m: dict[int, tuple[float, float]]


def play(
    plate: Plate,
    touches: Sequence[Touch],
    seconds: float,
    *,
    physics: Physics | None = None,
    room_kelvin: Sequence[tuple[float, float]] = ((0.0, ROOM_KELVIN),),
    seed: int = 1,
    window_ms: float = 10.0,
    step_ms: float = 5.0,
) -> Iterator[Moment]:
    """Play touches on a plate that differs from its file by `physics`; yield every reading with its truth."""
    scenario = Scenario(touches, None, plate, physics=physics or Physics(), environment_kelvin=room_kelvin)
    counter = (QuartzPlate if plate.counter.kind == "single-tone" else CombPlate)(plate, scenario, seed)
    measurement = Measurement(window_ms=window_ms, step_ms=step_ms)
    sensor = sensor_of(plate, measurement)
    assert isinstance(sensor, ForceSensor)
    processing: Any = sensor.make_processing(oscillator_hz(counter.description))
    gate, rate_hz = gate_ticks(plate), plate.counter.frame_rate_hz
    window: deque[CountedFrame] = deque(maxlen=round(measurement.window_s * rate_hz))
    total = round(seconds * rate_hz)
    for start in range(0, total, BLOCK_FRAMES):
        frames = counter.count(start * gate, start * gate, gate, min(BLOCK_FRAMES, total - start))
        for sequence, frame in enumerate(frames, start):
            window.append(frame)
            reading = _push(processing, sequence, (sequence + 1) * gate, frame)
            if reading is not None:
                yield _moment(plate, reading, list(window)[-max(1, round(reading.window_s * rate_hz)) :])


def _push(processing: Any, sequence: int, ticks: int, frame: CountedFrame) -> ForceReading | None:
    if isinstance(processing, SingleToneProcessing):
        return next(iter(processing.push(sequence, [ticks], b"".join(frame.channels))), None)
    tones = np.array([np.frombuffer(channel, _TONE) for channel in frame.channels])
    phase, offset, sigma, flags = (tones[name] for name in ("phase_turn32", "offset_hz16", "sigma_code", "flags"))
    reading: ForceReading | None = processing.push(sequence, ticks, phase, offset, sigma, flags == 0)
    return reading


def _moment(plate: Plate, reading: ForceReading, frames: Sequence[CountedFrame]) -> Moment:
    contacts = [contact for frame in frames for contact in frame.contacts]
    newton = dict.fromkeys((contact.id for contact in contacts), 0.0)
    for contact in contacts:
        newton[contact.id] += contact.force_newton[2] / len(frames)
    touches = [event.contact.touch for event in reading.events if event.event == "onset"]
    pressed = {force.site for force in reading.sites}
    if plate.counter.kind != "single-tone":  # under a cover, a touch loads its site's neighbours too
        touches += [contact.touch for contact in reading.contacts if np.isfinite(contact.touch.force_newton)]
        pressed = set()
    named = {int(plate.site_ids[site]) for site in pressed | {touch.site for touch in touches}}
    site, position_m = ({c.id: value(c) for c in contacts} for value in (lambda c: c.site, lambda c: c.position_m))
    return Moment(reading, named, newton, site, position_m)


TOUCHES = 5
SHORT_TOUCHES = 50
PAIRS = 16
COMB_PAIRS = 8
NEWTON = (0.2, 8.0)
COUNTED_SHARE = 0.05  # of its peak, before a touch's force counts
APART_M = 5e-3
PAIR_EVERY_S = 0.41
JOINT_NEWTON = 0.1  # of each touch, averaged over a window, before a reading may be expected to report both
HELD_NEWTON, HELD_S, HELD_SITE = 2.0, 30.0, 7
PRESS_AT_S = 5.0
WARM_KELVIN = 305.0
PHYSICS = Physics()
IDEAL = Physics(ideal=True)
CREEP = {"creep_fraction": 0.005}
HYSTERESIS = {"hysteresis_newton": 0.01 * 10.0}  # of the range
WARMTH = Physics(
    ideal=True,
    temperature_coefficient=PHYSICS.temperature_coefficient,
    temperature_coefficient_std=PHYSICS.temperature_coefficient_std,
    temperature_quadratic=PHYSICS.temperature_quadratic,
    temperature_cubic=PHYSICS.temperature_cubic,
    temperature_transient_s=PHYSICS.temperature_transient_s,
)


class Played(NamedTuple):
    """What the chain made of touches, one at a time, and the readings of their forces in newtons."""

    found: int  # touches whose site was named
    wrong: int  # readings that named another one
    more: int  # touches that were, at any time, reported to be possibly not alone
    error: Floats
    stated: Floats  # noise and systematic together
    middle: NDArray[np.int64]  # of each touch the reading in the middle, where its force rests


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def draw_touches(
    plate: Plate, random: np.random.Generator, count: int, times_s: tuple[float, float, float], kelvin_std: float = 0.0
) -> list[Touch]:
    """Touches on random sites one after the other, their forces spread evenly over the logarithm."""
    ramp_s, hold_s, gap_s = times_s
    forces = np.exp(random.uniform(*np.log(NEWTON).tolist(), count)).tolist()
    sites = random.choice(plate.site_ids, count).tolist()
    kelvin = (ROOM_KELVIN + kelvin_std * random.standard_normal(count)).tolist() if kelvin_std else [None] * count
    return [
        Touch(start_s=SETTLED_S + index * (2.0 * ramp_s + hold_s + gap_s), site=sites[index], rise_s=ramp_s,
              force_newton=forces[index], hold_s=hold_s, fall_s=ramp_s, kelvin=kelvin[index])
        for index in range(count)
    ]  # fmt: skip


def played(plate: Plate, touches: Sequence[Touch], **options: Any) -> Played:
    """Play touches of which no two overlap, to the end."""
    found, more, wrong = set[int](), set[int](), 0
    rows: list[tuple[float, ...]] = []
    for reading, named, newton, site, _ in play(
        plate, touches, touches[-1].start_s + touches[-1].duration_s + 0.05, **options
    ):
        wrong += not named <= set(site.values())
        found |= {contact for contact in site if site[contact] in named}
        more |= set(newton) if reading.status == "possibly_more" else set()
        rows += [
            (contact, force.force_newton - true, math.hypot(force.noise_newton, force.systematic_newton))
            for contact, true in newton.items()
            if reading.at_step and true > COUNTED_SHARE * touches[contact - 1].force_newton
            for force in reading.sites
            if plate.site_ids[force.site] == site[contact] and np.isfinite(force.force_newton)
        ]
    table = np.array(rows)
    _, first, count = np.unique(table[:, 0], return_index=True, return_counts=True)
    return Played(len(found), wrong, len(more), table[:, 1], table[:, 2], first + count // 2)


def with_response(plate: Plate, **response: float) -> Plate:
    values = {"hysteresis_newton": 0.0, "creep_fraction": 0.0, "creep_time_s": 20.0}
    return plate.model_copy(update={"response": Response(**values | response)})


def told_plate(name: str) -> Plate:
    """Return the plate with a file that states of its response and of warm touches what an emulated one has."""
    plate = load_plate(name).model_copy(update={"thermal": Thermal(contact_std_kelvin=3.0)})
    newton = PHYSICS.hysteresis_fraction * plate.force_max_newton
    return with_response(plate, hysteresis_newton=newton, creep_fraction=PHYSICS.creep_fraction)


def slow_touches(plate: Plate, physics: Physics) -> Played:
    touches = draw_touches(plate, np.random.default_rng(1), TOUCHES, (0.15, 0.5, 0.1))
    return played(plate, touches, physics=physics)


def test_ideal_sites_are_all_found_and_their_forces_right_to_3_millinewtons() -> None:
    ideal = slow_touches(load_plate("quartz16"), IDEAL)
    assert (ideal.found, ideal.wrong, ideal.more) == (TOUCHES, 0, 0)
    assert rms(ideal.error) <= 3e-3


@pytest.mark.parametrize(
    ("physics", "response", "limit_newton"),
    [
        (Physics(ideal=True, creep_fraction=0.005), CREEP, 10e-3),
        (Physics(ideal=True, hysteresis_fraction=0.01), HYSTERESIS, 35e-3),
    ],
)
def test_creep_and_hysteresis_are_taken_out_where_the_plate_file_determines_them(
    physics: Physics, response: dict[str, float], limit_newton: float
) -> None:
    plate = load_plate("quartz16")
    told_newton = rms(slow_touches(with_response(plate, **response), physics).error)
    assert told_newton <= limit_newton
    assert rms(slow_touches(plate, physics).error) > 3.0 * told_newton


def test_what_a_warm_finger_does_stays_within_what_is_stated_of_it() -> None:
    """Warm fingers on all sites one after the other, 1 N and 4 N; only the temperature disturbs."""
    thermal = Thermal(contact_std_kelvin=WARM_KELVIN - ROOM_KELVIN)
    plate = with_counter(load_plate("quartz16").model_copy(update={"thermal": thermal}), frame_rate_hz=50.0)
    table, random = plate.model_dump(exclude_none=True), np.random.default_rng(1)
    for site in table["sites"]:
        first = random.normal(WARMTH.temperature_coefficient, WARMTH.temperature_coefficient_std)
        coefficients = (first, WARMTH.temperature_quadratic, WARMTH.temperature_cubic)
        site["tones"][0]["temperature_coefficients"] = coefficients
    plate = Plate.model_validate(table)
    touches, start_s = list[Touch](), SETTLED_S + 1.0
    for order, site in enumerate(plate.site_ids.tolist()):
        newton, hold_s = (1.0, 4.0)[order % 2], (0.5, 5.0, 20.0)[order // 2 % 3]
        touches += [Touch(start_s=start_s, site=site, force_newton=newton, hold_s=hold_s, kelvin=WARM_KELVIN)]
        start_s += touches[-1].duration_s + 1.0
    warm = played(plate, touches, physics=WARMTH, window_ms=40.0, step_ms=40.0)
    assert (warm.found, warm.wrong) == (len(touches), 0)
    assert np.max(np.abs(warm.error) / warm.stated) <= 1.0


def test_stated_uncertainty_covers_the_errors_of_short_touches_and_is_not_much_larger() -> None:
    """On plates with every imperfection, some warm or cold; the plate file states what is known of them."""
    plate, random = told_plate("quartz16"), np.random.default_rng([1, 0])
    touches = draw_touches(plate, random, SHORT_TOUCHES, (0.03, 0.07, 0.03), kelvin_std=3.0)
    short = played(plate, touches, seed=int(random.integers(2**31)))
    assert (short.found, short.wrong) == (SHORT_TOUCHES, 0)
    for readings in (slice(None), short.middle):
        error, stated = short.error[readings], short.stated[readings]
        assert np.mean(np.abs(error) <= 2.0 * stated) >= 0.93
        assert rms(stated) <= 2.0 * rms(error)
    assert short.more <= 0.01 * SHORT_TOUCHES


def draw_pair(plate: Plate, start_s: float, random: np.random.Generator) -> list[Touch]:
    """Touches on sites 5 mm apart or more, which begin up to 0.1 s and end up to 0.2 s apart."""
    while True:
        first, second = random.choice(len(plate.site_ids), 2, replace=False)
        if np.linalg.norm(plate.site_positions_m[first] - plate.site_positions_m[second]) >= APART_M:
            break
    return [
        Touch(start_s=start_s + late_s, site=int(plate.site_ids[site]), force_newton=random.uniform(*NEWTON),
              rise_s=0.05, hold_s=random.uniform(0.08, 0.16), fall_s=0.05)
        for site, late_s in ((first, 0.0), (second, random.uniform(0.0, 0.1)))
    ]  # fmt: skip


def play_pairs(name: str, count: int) -> list[list[Moment]]:
    """Return of each pair the moments in which both touches press; no site besides them is ever named."""
    plate, random = told_plate(name), np.random.default_rng([1, 0])
    seed = int(random.integers(2**31))
    touches = [touch for n in range(count) for touch in draw_pair(plate, SETTLED_S + n * PAIR_EVERY_S, random)]
    joint: list[list[Moment]] = [[] for _ in range(count)]
    for moment in play(plate, touches, SETTLED_S + count * PAIR_EVERY_S, seed=seed):
        if moment.newton:
            assert moment.named <= set(moment.site.values())
        if sum(newton > JOINT_NEWTON for newton in moment.newton.values()) == 2:
            joint[(min(moment.newton) - 1) // 2].append(moment)
    return joint


def both(moments: list[Moment]) -> list[Moment]:
    return [moment for moment in moments if moment.named >= set(moment.site.values())]


def test_two_touches_on_captured_tones_are_found_and_never_put_elsewhere() -> None:
    """Of one pair a touch is the stronger tone at no corner."""
    pairs = play_pairs("quartz16", PAIRS)
    more = [sum(moment.reading.status == "possibly_more" for moment in pair) for pair in pairs]
    assert sum(bool(both(pair)) for pair in pairs) >= PAIRS - 2
    assert sum(bool(both(pair)) or some > 0 for pair, some in zip(pairs, more, strict=True)) >= PAIRS - 1
    assert sum(more) >= 0.9 * sum(map(len, pairs))


def test_two_touches_on_channelised_tones_are_both_found() -> None:
    pairs = [both(pair) for pair in play_pairs("comb16", COMB_PAIRS)]
    assert sum(map(bool, pairs)) >= COMB_PAIRS - 1  # 0.99 of them, less one deviation
    for moment in (moment for pair in pairs for moment in pair):
        places = np.array([contact.touch.position_m for contact in moment.reading.contacts])
        apart_m = np.linalg.norm(places[:, None] - np.array(list(moment.position_m.values())), axis=2)
        assert apart_m.min(axis=0).max() < 5e-3


def hold(plate: Plate, physics: Physics, window_ms: float) -> list[Floats]:
    """Hold 2 N on a site while the room swings by 2 K to both sides: force and stated deviation of each reading.

    Those of the site, and those of its contact: under a cover that is of a fit to all sites.
    """
    touch = Touch(start_s=PRESS_AT_S, site=HELD_SITE, force_newton=HELD_NEWTON, rise_s=0.15, hold_s=HELD_S, fall_s=0.15)
    times_s = np.arange(0.0, PRESS_AT_S + HELD_S + 10.0, 5.0).tolist()
    room = [(t, ROOM_KELVIN + 2.0 * math.sin(2.0 * math.pi * t / 800.0)) for t in times_s]
    own, contacts = [], []
    moments = play(plate, [touch], PRESS_AT_S + 0.15 + HELD_S, physics=physics, room_kelvin=room,
                   window_ms=window_ms, step_ms=window_ms)  # fmt: skip
    for moment in moments:
        if moment.newton.get(1, 0.0) > HELD_NEWTON * (1.0 - 1e-9):
            tracked = [contact.touch for contact in moment.reading.contacts]
            for rows, forces in ((own, moment.reading.sites), (contacts, tracked)):
                rows += [
                    (force.force_newton, math.hypot(force.noise_newton, force.systematic_newton))
                    for force in (*forces, None)
                    if force is not None and plate.site_ids[force.site] == HELD_SITE
                ] or [(math.nan, math.nan)]
    return [np.array(own), np.array(contacts)]


def test_a_press_held_while_the_room_warms_does_not_drift_where_all_tones_are_received() -> None:
    physics = Physics(ideal=True, temperature_coefficient=-5e-8)
    force, _ = hold(with_counter(load_plate("comb16"), frame_rate_hz=12.5), physics, 80.0)[0].T
    assert np.isfinite(force).all()
    assert abs(force[-125:].mean() - HELD_NEWTON) <= 1e-3  # over the last 10 s


@pytest.mark.parametrize(("name", "frame_rate_hz", "window_ms"), [("comb16", 12.5, 80.0), ("quartz16", 50.0, 40.0)])
def test_a_press_held_on_a_plate_with_every_imperfection_stays_within_what_is_stated(
    name: str, frame_rate_hz: float, window_ms: float
) -> None:
    for readings in hold(with_counter(told_plate(name), frame_rate_hz=frame_rate_hz), PHYSICS, window_ms):
        force, stated = readings.T
        assert len(force) > 0
        assert (np.abs(force - HELD_NEWTON) <= 2.0 * stated).all()


def test_a_thermal_shock_is_no_contact() -> None:
    """The room warms by 10 K within 5 s."""
    room = [(0.0, ROOM_KELVIN), (PRESS_AT_S, ROOM_KELVIN), (PRESS_AT_S + 5.0, ROOM_KELVIN + 10.0)]
    plate = with_counter(told_plate("comb16"), frame_rate_hz=50.0)
    moments = list(play(plate, [], PRESS_AT_S + 15.0, room_kelvin=room, window_ms=20.0, step_ms=20.0))
    assert len(moments) > 900
    assert [event for moment in moments for event in moment.reading.events] == []
