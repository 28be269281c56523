"""What the daemon does for each command."""

import asyncio
import time
from collections.abc import Mapping
from typing import Any, Final

from resonator_daemon.board.config import Config, timing_problems
from resonator_daemon.board.session.board_reader import BoardReader
from resonator_daemon.daemon.service.plate_publisher import PlatePublisher
from resonator_daemon.daemon.service.recordings import RecordingCommands, as_json_text
from resonator_daemon.measure.pipeline import control_requests
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.measure.pipeline.control_requests import ControlRequests
from resonator_daemon.measure.sensors.base import Sensor
from resonator_daemon.mqtt import verbs
from resonator_daemon.mqtt.codec import decode
from resonator_daemon.mqtt.commands import CommandRefusedError, Handler, NotAddressedError
from resonator_daemon.mqtt.daemon_state import DaemonState
from resonator_daemon.mqtt.event_file import EventFileError
from resonator_daemon.mqtt.event_log import EventPage, UnknownRunError
from resonator_daemon.mqtt.payloads import Condition, ContactEvent
from resonator_daemon.mqtt.topics import CONTACTS

EVENTS_BYTES_MAX: Final = 128 * 1024


class CommandHandlers:
    """Does what commands ask for; to be used from the event loop's thread only.

    Parameters
    ----------
    config
    daemon_boot_id
        Of this run.
    recording
        Executes the commands of recordings.
    pipeline, publisher, daemon, reader, requests
        Of the daemon.
    """

    def __init__(
        self,
        config: Config,
        daemon_boot_id: str,
        recording: RecordingCommands,
        *,
        pipeline: BoardPipeline,
        publisher: PlatePublisher,
        daemon: DaemonState,
        reader: BoardReader,
        requests: ControlRequests,
    ) -> None:
        self._plate = config.plate
        self._daemon_boot_id = daemon_boot_id
        self._pipeline = pipeline
        self._publisher = publisher
        self._daemon = daemon
        self._reader = reader
        self._requests = requests
        self._started_s = time.monotonic()
        self.by_verb: Mapping[str, Handler] = {
            "ping": self._ping,
            "events": self._events,
            "tare": self._tare,
            "start_recording": recording.start,
            "stop_recording": recording.stop,
            "mark": recording.mark,
            "set_window": self._set_window,
            "identify": self._identify,
        }

    def _ping(self, _request: verbs.Ping) -> verbs.Pong:
        uptime_s = time.monotonic() - self._started_s
        return verbs.Pong(t_ns=time.time_ns(), daemon_boot_id=self._daemon_boot_id, uptime_s=uptime_s)

    async def _events(self, request: verbs.Events) -> verbs.EventsAnswer:
        if not self._daemon.answers_for(request.daemon_boot_id):
            raise NotAddressedError
        if CONTACTS not in self._pipeline.sensor.streams:
            raise CommandRefusedError(
                "not_published", "this daemon publishes no contacts", "see decoder_id in contacts"
            )
        try:
            page = await self._publisher.stored_events(request.daemon_boot_id, request.after_seq, EVENTS_BYTES_MAX)
        except UnknownRunError:
            raise CommandRefusedError(
                "unknown_boot", "no such run of the daemon is stored", "retry without daemon_boot_id"
            ) from None
        except EventFileError as error:
            raise CommandRefusedError("storage_failed", as_json_text(error), "see the daemon's log") from None
        boot_id = request.daemon_boot_id or self._daemon_boot_id
        return await asyncio.to_thread(_events_answer, boot_id, page)  # takes milliseconds

    async def _tare(self, _request: verbs.Tare) -> verbs.TareAnswer:
        sensor = self._adjustable_sensor()
        if reason := await self._requests.apply(control_requests.Tare()):
            raise CommandRefusedError("not_untouched", reason, "take everything off the plate and retry")
        return verbs.TareAnswer(message="the present readings are the new zero", common_mode=sensor.common_mode)

    async def _set_window(self, request: verbs.SetWindow) -> verbs.SetWindowAnswer:
        sensor = self._adjustable_sensor()
        measurement = sensor.measurement.model_copy(update=request.model_dump(exclude_none=True))
        spans_ms = {"window_ms": measurement.window_ms, "step_ms": measurement.step_ms}
        if problems := timing_problems(spans_ms, self._plate):
            faults = "; ".join(f"{key}: got {value:g}; {sentence}" for key, value, sentence in problems)
            raise CommandRefusedError("window", faults, "send window_ms and step_ms that fit each other and the frames")
        if reason := await self._requests.apply(control_requests.SetWindow(measurement=measurement)):
            raise CommandRefusedError("window", reason, "see state/sensor")
        return verbs.SetWindowAnswer(window_s=measurement.window_s, step_s=measurement.step_s)

    async def _identify(self, _request: verbs.Identify) -> verbs.IdentifyAnswer:
        answered: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()

        def done(refused: str | None) -> None:
            if not answered.done():  # else nobody waits any more
                answered.set_result(refused)

        self._reader.blink(done)
        if (refused := await answered) is not None:
            raise CommandRefusedError("not_located", refused, "see state/link")
        return verbs.IdentifyAnswer()

    def _adjustable_sensor(self) -> Sensor[Any]:
        if self._plate.decodable:
            raise CommandRefusedError(
                "not_ready", "the plate has a skin, and no force sites", "its zero is followed by itself"
            )
        sensor, link = self._pipeline.sensor, self._pipeline.link
        if not sensor.ready or link is None or link.state != Condition.ONLINE:  # no board sends frames
            raise CommandRefusedError(
                "not_ready", "no force sites are being measured", "see state/link and state/sensor"
            )
        return sensor


def _events_answer(boot_id: str, page: EventPage) -> verbs.EventsAnswer:
    return verbs.EventsAnswer(
        daemon_boot_id=boot_id,
        events=tuple(decode(ContactEvent, payload) for payload in page.payloads),
        complete=page.complete,
        oldest_seq=page.oldest_seq,
        newest_seq=page.newest_seq,
        next_daemon_boot_id=page.next_boot_id,
    )
