"""Recordings of the link that commands start and stop; where they go and what they are called is the daemon's word."""

import asyncio
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from resonator_daemon.acquisition.recording_switch import (
    NothingRecordedError,
    RecordingNow,
    RecordingSummary,
    RecordingSwitch,
)
from resonator_daemon.config import Config, ReplayLink
from resonator_daemon.errors import OperatorError
from resonator_daemon.publishing.commands import CommandRefusedError
from resonator_daemon.publishing.payloads import RecordingInfo
from resonator_daemon.publishing.verbs import (
    Mark,
    MarkAnswer,
    RecordingSummaryInfo,
    StartRecording,
    StartRecordingAnswer,
    StopRecording,
    StopRecordingAnswer,
)

_DIRECTORY_HINT: Final = "see directory in [recording] of the daemon's configuration, and the room on that disk"


class RecordingCommands:
    """Starts, marks and stops recordings; disks may be slow, so that start and stop take a thread, one at a time.

    Parameters
    ----------
    config
        Whose plate, link and directory of recordings.
    name
        The daemon's, with which each file's name begins.
    switch
        Writes the file.
    """

    def __init__(self, config: Config, name: str, switch: RecordingSwitch) -> None:
        self._config = config
        self._name = name
        self._switch = switch
        self._one_at_a_time = asyncio.Lock()
        self._label: str | None = None  # of the recording that runs
        self._last: RecordingSummaryInfo | None = None

    async def start(self, request: StartRecording) -> StartRecordingAnswer:
        if isinstance(self._config.link, ReplayLink):
            raise CommandRefusedError("not_ready", f"{self._config.link} is a recording already", "copy the file")
        async with self._one_at_a_time:
            if (now := self._switch.current) is not None:
                return self._already(now, request.label)
            path = self._config.recording.directory / _file_name(self._name, datetime.now(UTC), request.label)
            try:
                await asyncio.to_thread(self._begin, path)
            except (OperatorError, OSError) as error:
                raise CommandRefusedError("recording_failed", str(error), _DIRECTORY_HINT) from None
            self._label = request.label
            if (now := self._switch.current) is None:
                raise CommandRefusedError("recording_failed", "the daemon is stopping", "send it again when it is back")
            return StartRecordingAnswer(file=as_json_text(now.path), since_t_ns=now.since_utc_ns, already=False)

    async def stop(self, _request: StopRecording) -> StopRecordingAnswer:
        async with self._one_at_a_time:
            summary = await asyncio.to_thread(self._switch.stop)
            if summary is not None:
                self._last = _told(summary)
            return StopRecordingAnswer(recording=self._last, already=summary is None)

    def mark(self, request: Mark) -> MarkAnswer:
        try:
            return MarkAnswer(t_ns=self._switch.mark(request.text))
        except NothingRecordedError as error:
            if (now := self._switch.current) is None:
                raise CommandRefusedError(
                    "not_recording", "nothing is being recorded", "send start_recording first"
                ) from None
            if now.failure is not None:
                raise _ended(now) from None
            raise CommandRefusedError("recording_failed", str(error), "send it again later") from None

    def _already(self, now: RecordingNow, label: str | None) -> StartRecordingAnswer:
        if now.failure is not None:
            raise _ended(now)
        if label is not None and label != self._label:
            raise CommandRefusedError(
                "recording", f"{as_json_text(now.path)} is being recorded", "send stop_recording first"
            )
        return StartRecordingAnswer(file=as_json_text(now.path), since_t_ns=now.since_utc_ns, already=True)

    def _begin(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._switch.start(path, self._config.plate, str(self._config.link))


def _file_name(name: str, now: datetime, label: str | None) -> str:
    utc = f"{now:%Y%m%dT%H%M%S}.{now.microsecond // 1000:03d}Z"
    return "-".join(filter(None, (name, utc, label))) + ".mcap"


def _ended(now: RecordingNow) -> CommandRefusedError:
    return CommandRefusedError(
        "recording_failed",
        f"{as_json_text(now.path)} takes nothing more: {as_json_text(now.failure)}",
        "send stop_recording, then start_recording",
    )


def _told(summary: RecordingSummary) -> RecordingSummaryInfo:
    return RecordingSummaryInfo(
        file=as_json_text(summary.file),
        file_bytes=summary.file_bytes,
        events=summary.events,
        events_missing=summary.events_missing,
        duration_s=summary.seconds,
        failure=as_json_text(summary.failure) if summary.failure else None,
    )


def recording_info(now: RecordingNow) -> RecordingInfo:
    """Return what `health` says of a recording that runs."""
    failure = as_json_text(now.failure) if now.failure else None
    return RecordingInfo(file=as_json_text(now.path), since_t_ns=now.since_utc_ns, failure=failure)


def as_json_text(text: object) -> str:
    """Return a path, or a text with one in it, as JSON can hold it: bytes that are no UTF-8 are replaced."""
    return str(text).encode(errors="replace").decode()
