"""Frames of one board to messages: its measurement chain, and under a skin the decoding of what that gives."""

from collections.abc import Callable, Sequence
from typing import Any

from resonator_daemon.config import Config, Measurement, ReplayLink
from resonator_daemon.decoding.skin import Skin, Wanted
from resonator_daemon.elastic import HalfSpace
from resonator_daemon.forces.contacts import ContactEvent
from resonator_daemon.forces.readings import ForceReading, SkinReading
from resonator_daemon.monitoring.latency import Latencies
from resonator_daemon.pipeline.chains import Chain, make_chain
from resonator_daemon.pipeline.reports import Reporter
from resonator_daemon.pipeline.sensor_state import SensorState
from resonator_daemon.pipeline.surface_decoding import MakeSurfaceDecoding, SurfaceDecoding
from resonator_daemon.pipeline.surface_reports import MeasuredFields
from resonator_daemon.pipeline.surface_stream import SurfaceSettings
from resonator_daemon.plate import Plate
from resonator_daemon.publishing.codec import Encoded
from resonator_daemon.publishing.payloads import ContactEvent as EventMessage
from resonator_daemon.publishing.payloads import Lost, Message
from resonator_daemon.publishing.topics import CONTACT_EVENT, CONTACTS, DECODED, DECODED_SUMMARY, FORCES, SIGNALS, Topic
from resonator_daemon.sensors.multitone import CombChain
from resonator_daemon.sensors.single_tone import SingleToneChain
from resonator_daemon.sensors.skin import SkinChain
from resonator_daemon.session.clock import Instant
from resonator_daemon.session.compatibility import oscillator_hz
from resonator_daemon.session.frames import BoardOnline, ChannelisedFrame, SingleToneFrame

_ONSET_S = 0.005  # an onset waits no longer for the frames after it
_TOPICS_OF_SURFACE = 3  # decoded, decoded/summary, contacts
_ANEW = "the board started anew"

Origin = tuple[SkinReading, Instant]


class Measuring:
    """Takes the frames of a board in order; to be used from the event loop's thread only.

    Parameters
    ----------
    config
    reporter
        Makes the messages.
    sensor
        Is told what each reading is worth.
    publish
        Takes topic and message.
    make_decoding
        Makes what decodes the frames of a skin.
    is_late
        Returns whether a message about a window that ends at this instant is too late; it is skipped then.

    Attributes
    ----------
    latencies
        Of the messages of forces, and of decoded maps.
    """

    def __init__(
        self,
        config: Config,
        reporter: Reporter,
        sensor: SensorState,
        publish: Callable[[Topic[Any], Any], None],
        make_decoding: MakeSurfaceDecoding,
        is_late: Callable[[Instant], bool],
    ) -> None:
        self._config = config
        self._reporter = reporter
        self._sensor = sensor
        self._publish = publish
        self._is_late = is_late
        self._skipped_late = 0
        self.latencies = Latencies(1 / config.plate.counter.frame_rate_hz)
        self._chain: Chain | None = None
        self._decoding = self._make(make_decoding)
        self._last_forces: tuple[ForceReading, Instant] | None = None

    async def run(self) -> None:
        """Decode, where there is a skin to be decoded, until cancelled."""
        if self._decoding is not None:
            await self._decoding.run()

    @property
    def force_chain(self) -> SingleToneChain | CombChain | None:
        """The chain of a plate of force sites, once a board counts."""
        return self._chain if isinstance(self._chain, SingleToneChain | CombChain) else None

    @property
    def frames_not_decoded(self) -> int:
        return self._decoding.frames_skipped if self._decoding is not None else 0

    @property
    def skipped_late(self) -> int:
        """Number of messages that were skipped as late, with those of frames that were not decoded in time."""
        frames = self._decoding.frames_late if self._decoding is not None else 0
        return self._skipped_late + _TOPICS_OF_SURFACE * frames

    @property
    def records_unusable(self) -> dict[str, int]:
        """Readings that gave no frequency, by cause."""
        return dict(self._chain.unusable) if isinstance(self._chain, SingleToneChain) else {}

    def set_measurement(self, measurement: Measurement) -> None:
        """Have forces measured over other windows from now on."""
        self._config = self._config.model_copy(update={"measurement": measurement})
        if (chain := self.force_chain) is not None:
            rate_hz = self._config.plate.counter.frame_rate_hz
            chain.set_window(round(measurement.window_s * rate_hz), round(measurement.step_s * rate_hz))

    def begin(self, board: BoardOnline) -> None:
        """Begin with a board, or anew with one that has nothing in common with the past."""
        if self._chain is None:
            self._chain = make_chain(self._config, oscillator_hz(board.description))
        elif isinstance(self._chain, SkinChain):
            self._chain.restart()
            if self._decoding is not None:
                self._decoding.interrupt(_ANEW)
        else:
            self._tell_of_last_forces(self._chain.restart())

    def read(self, frames: Sequence[SingleToneFrame]) -> list[ForceReading]:
        """Measure adjacent frames, one or more; return the readings, which the caller publishes in order."""
        if not isinstance(self._chain, SingleToneChain):
            return []
        ticks = [frame.board_ticks for frame in frames]
        return self._chain.push(frames[0].index, ticks, b"".join([frame.payload for frame in frames]))

    def publish(self, reading: ForceReading, gate_middle: Instant) -> None:
        """Publish a reading; `gate_middle` is that of the last gate in its window."""
        self._last_forces = (reading, gate_middle)
        self._tell(reading.events, reading, gate_middle)
        if reading.at_step:
            compensation = reading.compensation
            self._sensor.update(
                reading.status,
                reading.reason,
                compensation.common_mode,
                gate_middle.utc_ns,
                compensation.plate_kelvin,
            )
            if self._is_late(gate_middle):
                self._skip(FORCES, CONTACTS)
                return
            self._count_latency(FORCES, gate_middle)
            self._publish(FORCES, self._reporter.forces(reading, gate_middle))
            self._publish(CONTACTS, self._reporter.contacts(reading, gate_middle))

    def end_contacts(self, reason: str) -> None:
        """Release all contacts when frames have stopped arriving: their state is unknown from then on."""
        if self.force_chain is not None:
            self._tell_of_last_forces(self.force_chain.end_contacts(reason))
        elif self._decoding is not None:
            self._decoding.interrupt(reason)

    def measure(self, frame: ChannelisedFrame) -> None:
        """Measure a frame and publish what follows from it."""
        if isinstance(self._chain, SkinChain):
            self._measure_signals(self._chain, frame)
        elif isinstance(self._chain, CombChain):
            reading = self._chain.push(
                frame.index, frame.board_ticks, frame.phase_turn32, frame.offset_hz16, frame.sigma_code, frame.known
            )
            if reading is not None:
                self.publish(reading, frame.gate_middle)

    def _tell(self, events: Sequence[ContactEvent], reading: ForceReading, gate_middle: Instant) -> None:
        for event in events:
            self._publish(CONTACT_EVENT, self._reporter.event(event, reading, gate_middle))

    def _tell_of_last_forces(self, events: Sequence[ContactEvent]) -> None:
        if self._last_forces is not None:
            self._tell(events, *self._last_forces)

    def _measure_signals(self, chain: SkinChain, frame: ChannelisedFrame) -> None:
        reading = chain.push(frame.index, frame.board_ticks, frame.offset_hz16, frame.variance_hz2)
        self._sensor.update(reading.status, reading.reason, (reading.common_mode,), frame.gate_middle.utc_ns)
        if self._is_late(frame.gate_middle):
            self._skip(SIGNALS)
            if self._decoding is not None and reading.status == "ok":
                self._skip(DECODED, DECODED_SUMMARY, CONTACTS)
            return
        self._publish(SIGNALS, self._reporter.signals(reading, frame.gate_middle))
        if self._decoding is not None and reading.status == "ok":
            origin = (reading, frame.gate_middle)
            self._decoding.offer(origin, self._reporter.surface_frame(*origin))

    def _make(self, make_decoding: MakeSurfaceDecoding) -> SurfaceDecoding[Origin] | None:
        skin, wanted = self._config.plate.skin, self._config.decoding
        if skin is None:
            return None
        if wanted.method == "off":
            self._sensor.explain("decoding is off")
            return None
        if wanted.apart:
            self._sensor.explain("decoded by another process: resonatord decode")
            return None
        plate = self._config.plate
        described = Skin(
            HalfSpace(skin.youngs_modulus_pascal, skin.poisson_ratio),
            plate.site_positions_m,
            skin.depth_m,
            skin.gain_std,
            skin.correlation_length_m,
            skin.tangential_ratio,
        )
        settings = SurfaceSettings(
            described,
            Wanted(wanted.method, wanted.contact_physics, wanted.friction_coefficient, wanted.displacement),
            plate.site_ids,
            plate.grid.pitch_m if plate.grid else None,
            uncertainty=wanted.uncertainty,
        )
        return make_decoding(settings, self)

    def deliver(self, origin: Origin, topic: Topic[Any], message: Message | Encoded) -> None:
        """Publish a message about a decoded frame, unless that took too long."""
        if self._is_late(origin[1]):
            self._skipped_late += 1  # it has its number already
            return
        if topic is DECODED:
            self._count_latency(DECODED, origin[1])
        self._publish(topic, message)

    def deliver_event(self, _origin: Origin, event: EventMessage) -> None:
        """Publish an event of a contact on a skin."""
        self._publish(CONTACT_EVENT, self._reporter.numbered(event))

    def announce(self, note: str) -> None:
        """Report steps and failures of decoding in the state of the sensor."""
        self._sensor.explain(note)

    def lost(self, _origin: Origin) -> Lost:
        """Return the losses up to now."""
        return self._reporter.lost()

    def contacts_header(self, origin: Origin) -> MeasuredFields:
        """Return the header of one more message on `contacts` about a frame."""
        return self._reporter.contacts_header(*origin)

    def _skip(self, *topics: Topic[Any]) -> None:
        self._reporter.skip(*topics)
        self._skipped_late += len(topics)

    def _count_latency(self, topic: Topic[Any], gate_middle: Instant) -> None:
        if not isinstance(self._config.link, ReplayLink):  # whose clock is that of the recording
            self.latencies.count(topic, gate_middle)


def step_ns(plate: Plate, measurement: Measurement) -> int:
    """Return the time from message to message on the topics of what is measured."""
    return round(1e9 * (measurement.step_s if plate.skin is None else 1 / plate.counter.frame_rate_hz))


def useful_together(plate: Plate, measurement: Measurement) -> tuple[int, ...]:
    """Return how many frames are of use together: those of a message, and those in which an onset may wait."""
    if plate.counter.kind != "single-tone":
        return (1,)
    rate_hz = plate.counter.frame_rate_hz
    step_frames = round(measurement.step_s * rate_hz)
    onset_frames = max(1, round(_ONSET_S * rate_hz))
    return (step_frames,) if step_frames <= onset_frames else (onset_frames, step_frames)
