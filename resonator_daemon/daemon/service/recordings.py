"""Recordings of the link, by command or without end, with the published messages next to the link's bytes."""

import asyncio
import logging
from collections.abc import Callable
from typing import Any, Final

from resonator_daemon.base.errors import UserError, reason_of
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.values import plate_text, settings_text
from resonator_daemon.board.recording.file_series import Series
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.recorder import Recorder
from resonator_daemon.board.recording.switch import NothingRecordedError, RecordingSwitch
from resonator_daemon.board.recording.writer import Published
from resonator_daemon.mqtt import verbs
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.commands import CommandRefusedError
from resonator_daemon.mqtt.payloads import RecordingInfo
from resonator_daemon.mqtt.topics import JSON, Topic

log = logging.getLogger(__name__)

_MINUTE_NS: Final = 60 * 10**9
_DIRECTORY_HINT: Final = "see directory in [recording] of the daemon's configuration, and the free space of that disk"


class RecordingCommands:
    """Starts, marks and stops recordings; disks may be slow, so that start and stop take a thread, one at a time.

    Parameters
    ----------
    config
        Whose plate, link and directory of recordings.
    name
        The daemon's, with which each file's name begins.
    switch
        Writes the files.
    daemon_boot_id, config_sha256
        Written into them.
    """

    def __init__(
        self,
        config: Config,
        name: str,
        switch: RecordingSwitch,
        *,
        daemon_boot_id: str | None = None,
        config_sha256: str | None = None,
    ) -> None:
        self._config = config
        self._name = name
        self._switch = switch
        self._daemon_boot_id = daemon_boot_id
        self._config_sha256 = config_sha256
        self._one_at_a_time = asyncio.Lock()
        self._label: str | None = None  # of the recording that runs
        self._by_config = False  # whether the configuration began it
        self._last: verbs.RecordingSummaryInfo | None = None

    async def start(self, request: verbs.StartRecording) -> verbs.StartRecordingAnswer:
        if self._config.link.recording_path is not None:
            raise CommandRefusedError("not_ready", f"{self._config.link} is a recording already", "copy the file")
        async with self._one_at_a_time:
            if (now := self._switch.current) is not None:
                return self._already(now, request.label)
            try:
                await asyncio.to_thread(self._begin, request.label, late=False)
            except (UserError, OSError) as error:
                reason = reason_of(error) if isinstance(error, OSError) else str(error)
                raise CommandRefusedError("recording_failed", reason, _DIRECTORY_HINT) from None
            self._label, self._by_config = request.label, False
            if (now := self._switch.current) is None:
                raise CommandRefusedError("recording_failed", "the daemon is stopping", "send it again when it is back")
            return self._answer(now, was_active=False)

    async def keep_recording(self) -> None:
        """Record from now on, if `continuous` is configured and nothing is recorded."""
        async with self._one_at_a_time:
            wanted = self._config.recording.autostart and self._config.link.recording_path is None
            if wanted and self._switch.current is None:
                await asyncio.to_thread(self._begin, None, late=True)
                self._label, self._by_config = None, True

    async def adopt(self, config: Config, config_sha256: str | None) -> None:
        """Use another configuration.

        A recording that the configuration began ends where `[recording]` changed, and one by the new configuration
        begins, if that is `continuous`; a recording by a command goes on as it began.
        """
        changed = config.recording != self._config.recording
        self._config, self._config_sha256 = config, config_sha256
        if changed:
            async with self._one_at_a_time:
                if self._by_config and (ended := await self._end()) is not None:
                    log.info("recording ended with %s: [recording] was changed", ended.path)
            await self.keep_recording()

    async def stop(self, _request: verbs.StopRecording) -> verbs.StopRecordingAnswer:
        async with self._one_at_a_time:
            ended = await self._end()
            return verbs.StopRecordingAnswer(recording=self._last, was_active=ended is not None)

    async def _end(self) -> Recorder | None:
        ended = await asyncio.to_thread(self._switch.stop)
        if ended is not None:
            self._last = _summary_info(ended)
        return ended

    def mark(self, request: verbs.Mark) -> verbs.MarkAnswer:
        try:
            return verbs.MarkAnswer(t_ns=self._switch.mark(request.text))
        except NothingRecordedError as error:
            if (now := self._switch.current) is None:
                raise CommandRefusedError(
                    "not_recording", "nothing is being recorded", "send start_recording first"
                ) from None
            if now.failure is not None:
                raise _ended(now) from None
            raise CommandRefusedError("recording_failed", str(error), "send it again later") from None

    def _already(self, now: Recorder, label: str | None) -> verbs.StartRecordingAnswer:
        if now.failure is not None:
            raise _ended(now)
        if label is not None and label != self._label:
            raise CommandRefusedError(
                "recording", f"{as_json_text(now.path)} is being recorded", "send stop_recording first"
            )
        return self._answer(now, was_active=True)

    def _answer(self, now: Recorder, *, was_active: bool) -> verbs.StartRecordingAnswer:
        file, since_t_ns = as_json_text(now.path), now.since.utc_ns
        return verbs.StartRecordingAnswer(file=file, since_t_ns=since_t_ns, was_active=was_active)

    def _begin(self, label: str | None, *, late: bool) -> None:
        """Begin a recording; it takes a while, and waits for the disk."""
        about = origin(self._config, self._name, self._daemon_boot_id, self._config_sha256)
        self._switch.start(_series(self._config, self._name, label, late=late), about)


class RecordedMessages:
    """Records published messages; never waits.

    States and descriptions, which are retained, are always recorded; what is measured where it is wanted. Arrays are
    not: they have ten times the size of the bytes that they come from.

    Parameters
    ----------
    publish
        Receives the messages: that of a recorder, or of a switch before one.
    include_messages
        Whether to record what is measured.
    """

    def __init__(self, publish: Callable[[Published], None], *, include_messages: bool) -> None:
        self._publish = publish
        self._schemas: dict[str, dict[str, Any]] = {}
        self.include_messages = include_messages

    def record(self, topic: Topic[Any], message: Any) -> None:
        """Record a message if its topic is to be recorded."""
        if not (topic.retained or self.include_messages) or topic.content_type != JSON:
            return
        if topic.path not in self._schemas:
            self._schemas[topic.path] = topic.payload.model_json_schema(mode="serialization")
        schema = self._schemas[topic.path]
        self._publish(Published(topic.path, message.t_ns, encode(message), schema, topic.retained))


def origin(config: Config, name: str | None, daemon_boot_id: str | None, config_sha256: str | None) -> Origin:
    """Return the origin that a recording carries; takes a third of a second for a plate of 400 sites."""
    return Origin(
        plate=config.plate,
        link=str(config.link),
        name=name,
        daemon_boot_id=daemon_boot_id,
        config_sha256=config_sha256,
        plate_text=plate_text(config.plate),
        settings_text=settings_text(config),
    )


def _series(config: Config, name: str, label: str | None, *, late: bool) -> Series:
    settings = config.recording
    return Series(
        directory=settings.directory,
        name=name,
        label=label,
        file_max_bytes=round(settings.file_max_mb * 1e6),
        file_max_ns=round(settings.file_max_minutes * _MINUTE_NS),
        max_total_bytes=round(settings.max_total_mb * 1e6),
        min_free_bytes=round(settings.min_free_mb * 1e6),
        resumes=settings.autostart,
        begins_late=late,
    )


def _ended(now: Recorder) -> CommandRefusedError:
    return CommandRefusedError(
        "recording_failed",
        f"{as_json_text(now.path)} takes nothing more: {as_json_text(now.failure.text if now.failure else '')}",
        "send stop_recording, then start_recording",
    )


def _summary_info(ended: Recorder) -> verbs.RecordingSummaryInfo:
    return verbs.RecordingSummaryInfo(
        file=as_json_text(ended.path),
        files=ended.counts.files,
        all_bytes=ended.all_bytes,
        events=ended.written.events,
        events_missing=ended.counts.events_missing,
        duration_s=ended.seconds,
        failure_code=ended.failure.code if ended.failure else None,
        failure=as_json_text(ended.failure.text) if ended.failure else None,
    )


def recording_info(switch: RecordingSwitch) -> RecordingInfo:
    """Return the part of `health` about recordings."""
    now = switch.current
    failure = now.failure if now else None  # the recording goes on meanwhile
    return RecordingInfo(
        file=as_json_text(now.path) if now and now.counts.files else None,
        since_t_ns=now.since.utc_ns if now else None,
        failure_code=failure.code if failure else None,
        failure=as_json_text(failure.text) if failure else None,
        **switch.totals._asdict(),
    )


def as_json_text(text: object) -> str:
    """Return a path, or a text with one in it, as JSON can hold it: bytes that are no UTF-8 are replaced."""
    return str(text).encode(errors="replace").decode()
