"""Sensor under a skin: the signals of its sites, and the surface that a decoder makes of them."""

from collections.abc import Sequence
from typing import Any, ClassVar, Final

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.compatibility import oscillator_hz
from resonator_daemon.board.session.frames import BoardOnline, ChannelisedFrame, Frame, variance_of
from resonator_daemon.estimate.forces.readings import SkinReading
from resonator_daemon.estimate.surface.skin import DecodingOptions, refuse_undecodable
from resonator_daemon.estimate.tones.tone_detector import MultitoneDetector, ToneDetector
from resonator_daemon.measure.sensors.base import Sensor
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones, all_tones
from resonator_daemon.measure.sensors.output import BOARD_RESTARTED, MessageOutput
from resonator_daemon.measure.sensors.skin_processing import SkinProcessing, ToneArray
from resonator_daemon.measure.sensors.surface_decoding import MakeSurfaceDecoding, SurfaceDecoding
from resonator_daemon.measure.sensors.surface_requests import SurfaceFrame, SurfaceSettings, stated_skin
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.payloads import Condition, ContactEvent, Lost, Message, Signals, Status
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS, DECODED, DECODED_SUMMARY, SIGNALS, HeaderFields, Topic

_SURFACE: Final = (DECODED, DECODED_SUMMARY, CONTACTS)
_CONDITIONS: Final = {  # while nothing is decoded
    ReasonCode.DECODER_STARTING: Condition.STARTING,
    ReasonCode.DECODER_CRASHED: Condition.STALLED,
    ReasonCode.DECODER_HUNG: Condition.STALLED,
    ReasonCode.UNDECODABLE: Condition.REFUSED,
}

Origin = tuple[SkinReading, Instant]


class SkinSensor(Sensor[SkinReading]):
    """Sites under a skin, each with three signals."""

    replaces = "skin"
    result: ClassVar[Topic[Any]] = DECODED
    adjustable: ClassVar[bool] = False
    independent_at_rest: ClassVar[bool] = True
    _processing: SkinProcessing | None = None
    _decoding: SurfaceDecoding[Origin] | None = None

    @property
    def summary(self) -> str:
        return "all sites are read"

    @property
    def streams(self) -> tuple[Topic[Any], ...]:
        decoded_here = self.decoding.method != "off" and not self.decoding.external
        return (SIGNALS, *_SURFACE) if decoded_here else (SIGNALS,)

    @property
    def window_s(self) -> float:
        return 1 / self.plate.counter.frame_rate_hz

    @property
    def step_s(self) -> float:
        return 1 / self.plate.counter.frame_rate_hz

    @property
    def rate_hz(self) -> float:
        return self.plate.counter.frame_rate_hz

    @property
    def expected_tones(self) -> ExpectedTones:
        return all_tones(self.plate)

    def tone_detector(self, frames: int, oscillator_hz: Floats) -> ToneDetector:
        return MultitoneDetector(frames, 1 / self.plate.counter.frame_rate_hz, oscillator_hz)

    def connect(self, output: MessageOutput, make_decoding: MakeSurfaceDecoding | None) -> None:
        self._output = output
        decoding = self.decoding
        if decoding.method == "off":
            output.state.explain(Reason(ReasonCode.DECODING_OFF, "decoding is off"))
            return
        if decoding.external:
            elsewhere = Reason(ReasonCode.DECODED_ELSEWHERE, "decoded by another process: resonatord decode")
            output.state.explain(elsewhere)
            return
        if (settings := self._settings()) is None:
            return
        if make_decoding is None:
            from resonator_daemon.measure.sensors.surface_worker import SequentialDecoding  # loads much of scipy

            self._decoding = SequentialDecoding(settings, self)
        else:
            self.announce(Reason(ReasonCode.DECODER_STARTING, "decoder is being set up"))
            self._decoding = make_decoding(settings, self)

    @property
    def problems(self) -> tuple[str, ...]:
        try:
            if settings := self._settings():
                refuse_undecodable(settings.skin, settings.options)
        except ValueError as error:
            return (str(error),)
        return ()

    def _settings(self) -> SurfaceSettings | None:
        """Return the settings of the decoder; None if nothing is decoded here."""
        plate, decoding, skin = self.plate, self.decoding, self.plate.required_skin
        if decoding.method == "off" or decoding.external:
            return None
        return SurfaceSettings(
            stated_skin(skin, plate.site_positions_m),
            DecodingOptions(
                decoding.method, decoding.contact_physics, decoding.friction_coefficient, decoding.displacement
            ),
            plate.site_ids,
            plate.grid.pitch_m if plate.grid else None,
            uncertainty=decoding.uncertainty,
        )

    @property
    def at_rest(self) -> bool:
        return self._processing is not None and self._processing.at_rest

    @property
    def ready(self) -> bool:
        return self._processing is not None

    def begin(self, board: BoardOnline) -> None:
        if self._processing is not None:
            self._processing.restart()
            self.end_contacts(BOARD_RESTARTED)
            return
        plate, tones = self.plate, self.plate.tones
        array = ToneArray(
            tones.f0_hz,
            tones.sensitivity,
            oscillator_hz(board.description),
            tones.site_index,
            tones.signal_index,
            plate.required_skin.youngs_modulus_pascal,
        )
        self._processing = SkinProcessing(array, gate_s=self.window_s)

    def measure(self, frames: Sequence[Frame]) -> Sequence[SkinReading]:
        processing = self._processing
        if processing is None:
            return ()
        readings = []
        for frame in frames:
            if isinstance(frame, ChannelisedFrame):
                tones = frame.tones
                readings.append(
                    processing.push(frame.index, frame.board_ticks, tones["offset_hz16"], variance_of(tones))
                )
        return readings

    def publish(self, reading: SkinReading, gate_middle: Instant) -> None:
        output = self._output
        decoding = self._decoding if reading.status == "ok" else None
        output.state.update(reading.status, reading.reason, (reading.common_mode,), gate_middle)
        if output.is_late(gate_middle):
            output.skip(SIGNALS)
            if decoding is not None:
                output.skip(*_SURFACE)
                decoding.skip_late()
            return
        window, next_seq = output.window(reading, gate_middle), output.headers.next_seq
        output.publish(
            SIGNALS,
            Signals(
                seq=next_seq(SIGNALS),
                **window,
                signals=reading.signals,
                noise_std=reading.noise_std,
                status=Status(reading.status),
            ),
        )
        if decoding is not None:
            # If the frame is skipped, these numbers `seq` are missing.
            header: HeaderFields = {"seq": next_seq(DECODED), **window}
            decoding.offer(
                (reading, gate_middle),
                SurfaceFrame(header, next_seq(CONTACTS), reading.signals, reading.noise_std, reading.at_rest),
            )

    def end_contacts(self, reason: Reason) -> None:
        if self._decoding is not None:
            self._decoding.interrupt(reason)

    def tare(self) -> str | None:
        return "no force sites are being measured"

    @property
    def skipped_late(self) -> int:
        return len(_SURFACE) * self._decoding.frames_late if self._decoding is not None else 0

    @property
    def suspect_sites(self) -> tuple[int, ...]:
        return self._decoding.suspects if self._decoding is not None else ()

    async def run(self) -> None:
        if self._decoding is not None:
            await self._decoding.run()

    def deliver(self, origin: Origin, topic: Topic[Any], message: Message | Encoded) -> None:
        """Publish a message about a decoded frame, unless decoding took too long."""
        _, gate_middle = origin
        if self._output.is_late(gate_middle):
            self._output.skipped_late += 1  # it has its number already
        elif topic is DECODED:
            self._output.publish_result(topic, message, gate_middle)
        else:
            self._output.publish(topic, message)

    def deliver_event(self, _origin: Origin, event: ContactEvent) -> None:
        """Publish an event of a contact under the next number of its topic."""
        seq = self._output.headers.next_seq(CONTACT_EVENT)
        self._output.publish(CONTACT_EVENT, event.model_copy(update={"seq": seq}))

    def announce(self, note: Reason | None) -> None:
        """Report steps and failures of decoding in the state of the sensor."""
        condition = _CONDITIONS.get(note.code, Condition.ONLINE) if note is not None else Condition.ONLINE
        self._output.state.explain(note, condition)

    def lost(self, _origin: Origin) -> Lost:
        """Return the losses up to now."""
        return self._output.headers.lost()

    def contacts_header(self, origin: Origin) -> HeaderFields:
        """Return the header of one more message on `contacts` about a frame."""
        return {"seq": self._output.headers.next_seq(CONTACTS), **self._output.window(*origin)}
