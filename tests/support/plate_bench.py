"""An emulated plate counted into a sensor, without link, broker and clock: readings compared with the truth."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import SINGLE_TONE_STRUCT, TONE_FIELDS, SingleToneRecord
from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config import Measurement
from resonator_daemon.board.session.compatibility import gate_ticks, oscillator_hz
from resonator_daemon.estimate.forces.readings import ForceReading
from resonator_daemon.measure.sensors.force_sensor import ForceSensor
from resonator_daemon.measure.sensors.kinds import sensor_of
from resonator_daemon.measure.sensors.single_tone_processing import SingleToneProcessing
from simulators.comb_plate import CombPlate
from simulators.physics import Physics
from simulators.plate import CountedFrame
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import Scenario
from simulators.scenario_file import Touch

ROOM_KELVIN = 298.15
SETTLED_S = 0.4  # from the first frame on until the sensor has its baseline
LEVEL_TOUCH_S = 0.005
BLOCK_FRAMES = 40

_TONE = np.dtype([(field.name, "<" + field.code) for field in TONE_FIELDS])


class Moment(NamedTuple):
    """A reading, and by contact the true force averaged over its window, with the site's id where it is on one."""

    reading: ForceReading
    true_newton: dict[int, float]
    true_site: dict[int, int | None]
    true_position_m: dict[int, tuple[float, float]]


class PlateBench:
    """Plays touches on a plate."""

    def __init__(
        self,
        plate: Plate,
        touches: Sequence[Touch],
        *,
        physics: Physics | None = None,
        environment_kelvin: Sequence[tuple[float, float]] = ((0.0, ROOM_KELVIN),),
        seed: int = 0,
        window_ms: float = 10.0,
        step_ms: float = 5.0,
    ) -> None:
        """Prepare a plate as its file describes it; the emulated one differs from it by `physics`."""
        scenario = Scenario(touches, None, plate, physics=physics or Physics(), environment_kelvin=environment_kelvin)
        emulated = QuartzPlate if plate.counter.kind == "single-tone" else CombPlate
        self._counter = emulated(plate, scenario, seed)
        measurement = Measurement(window_ms=window_ms, step_ms=step_ms)
        sensor = sensor_of(plate, measurement)
        assert isinstance(sensor, ForceSensor)
        self.processing: Any = sensor.make_processing(oscillator_hz(self._counter.description))
        self.site_ids: list[int] = plate.site_ids.tolist()
        self._gate_ticks = gate_ticks(plate)
        self._frame_rate_hz = plate.counter.frame_rate_hz
        self._window: deque[CountedFrame] = deque(maxlen=round(measurement.window_s * self._frame_rate_hz))
        self._counted_frames = self._pushed_frames = 0

    def play(self, seconds: float) -> Iterator[Moment]:
        """Go on for so long; every reading of the sensor, with its truth."""
        for frame in self.count(seconds):
            self._window.append(frame)
            reading = self.push(frame)
            if reading is not None:
                yield self._moment(reading)

    def count(self, seconds: float) -> Iterator[CountedFrame]:
        """Let plate and counter go on for so long."""
        end = self._counted_frames + round(seconds * self._frame_rate_hz)
        while self._counted_frames < end:
            ticks, frames = self._counted_frames * self._gate_ticks, min(BLOCK_FRAMES, end - self._counted_frames)
            self._counted_frames += frames
            yield from self._counter.count(ticks, ticks, self._gate_ticks, frames)

    def push(self, frame: CountedFrame) -> ForceReading | None:
        """Process the next frame."""
        sequence, processing = self._pushed_frames, self.processing
        self._pushed_frames += 1
        ticks = self._pushed_frames * self._gate_ticks
        if isinstance(processing, SingleToneProcessing):
            readings = processing.push(sequence, [ticks], b"".join(frame.channels))
            return readings[0] if readings else None
        tones = np.array([np.frombuffer(channel, _TONE) for channel in frame.channels])
        known = tones["flags"] == 0
        return processing.push(sequence, ticks, tones["phase_turn32"], tones["offset_hz16"], tones["sigma_code"], known)

    def _moment(self, reading: ForceReading) -> Moment:
        frames = max(1, round(reading.window_s * self._frame_rate_hz))
        newton: dict[int, float] = {}
        site: dict[int, int | None] = {}
        position: dict[int, tuple[float, float]] = {}
        for frame in list(self._window)[-frames:]:
            for contact in frame.contacts:
                newton[contact.id] = newton.get(contact.id, 0.0) + contact.force_newton[2] / frames
                site[contact.id] = contact.site
                position[contact.id] = contact.position_m
        return Moment(reading, newton, site, position)

    def named_sites(self, reading: ForceReading) -> set[int]:
        """Return the ids of the sites with a force, or with the onset of a contact, in a reading.

        Under a cover a touch also loads neighbouring sites: there each contact counts, by its nearest site.
        """
        touches = [event.contact.touch for event in reading.events if event.event == "onset"]
        pressed = {touch.site for touch in touches} | {force.site for force in reading.sites}
        if not isinstance(self.processing, SingleToneProcessing):
            touches += [contact.touch for contact in reading.contacts if np.isfinite(contact.touch.force_newton)]
            pressed = {touch.site for touch in touches}
        return {self.site_ids[site] for site in pressed}


def corner_levels_db(plate: Plate, seed: int) -> NDArray[np.float64]:
    """Level (sites, corners) at which an emulated single-tone counter receives each site when it alone is pressed."""
    touches = [
        Touch(
            start_s=LEVEL_TOUCH_S * order,
            site=int(site),
            force_newton=1.0,
            rise_s=0.0,
            hold_s=0.8 * LEVEL_TOUCH_S,
            fall_s=0.0,
        )
        for order, site in enumerate(plate.site_ids)
    ]
    bench = PlateBench(plate, touches, physics=Physics(ideal=True), seed=seed)
    levels = np.full((len(plate.site_ids), len(plate.transducers_m)), -np.inf)
    order = {site: index for index, site in enumerate(bench.site_ids)}
    for frame in bench.count(LEVEL_TOUCH_S * len(touches)):
        for contact in frame.contacts:
            assert contact.site is not None
            records = [SingleToneRecord(*SINGLE_TONE_STRUCT.unpack(channel)) for channel in frame.channels]
            levels[order[contact.site]] = [record.attenuation_db256 / -256.0 for record in records]
    return levels
