"""An emulated plate counted into a sensor, without link, broker and clock: readings compared with the truth."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from firmware_protocol.layouts import TONE_FIELDS
from resonator_daemon.base.plate import Plate
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
