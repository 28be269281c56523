"""Recording of a board's link to files, without publishing."""

import hashlib
import secrets
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from resonator_daemon.config import Config, load_config
from resonator_daemon.daemon.recording_commands import origin
from resonator_daemon.errors import (
    ConfigurationError,
    ExitCode,
    IncompatibleBoardError,
    InterruptedCommandError,
    UserError,
)
from resonator_daemon.recording.file_series import Series
from resonator_daemon.recording.recorder import Recorder
from resonator_daemon.session.board_reader import BoardReader
from resonator_daemon.session.counters import LinkCounters
from resonator_daemon.session.frames import (
    BoardOnline,
    BoardRefused,
    ChannelisedFrame,
    LinkChange,
    ReaderFailed,
    SingleToneFrame,
)

if TYPE_CHECKING:
    from resonator_daemon.pipeline.board_pipeline import BoardPipeline

_OPEN_S: Final = 10.0  # in which a board must count
_TURN_S: Final = 0.2
_PROGRESS_S: Final = 1.0


class NoBoardError(UserError):
    """No board counts on the link."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_board"


class RecordingEndedError(UserError):
    """The file takes no more, or the reader failed."""

    exit_code = ExitCode.FAILED
    code = "ended"


@dataclass(frozen=True)
class RecordOptions:
    """What to record to which files; None is no bound.

    Parameters
    ----------
    output
        The file; with a bound of each file's size or time the first part of their names, which end with the time.
    seconds
        From the first frame on.
    max_mb, max_minutes
        After which the next file begins.
    derived
        Also record what is measured.
    """

    output: Path
    seconds: float | None = None
    max_mb: float | None = None
    max_minutes: float | None = None
    derived: bool = False

    @property
    def place(self) -> Path | Series:
        if self.max_mb is None and self.max_minutes is None:
            return self.output
        return Series(
            self.output.parent,
            self.output.stem,
            file_max_bytes=None if self.max_mb is None else round(self.max_mb * 1e6),
            file_max_ns=None if self.max_minutes is None else round(self.max_minutes * 60e9),
        )


def record(config_path: Path, options: RecordOptions) -> dict[str, Any]:
    """Record until the time is over or SIGINT, SIGTERM or SIGHUP comes; return file, counters and duration.

    Raises
    ------
    InterruptedCommandError
        One of them came before the time was over.
    UserError
        The configuration cannot be used, the file cannot be made or takes no more, or no board counts.
    """
    config = load_config(config_path)
    if config.link.recording_path is not None:
        raise ConfigurationError(f"link: {config.link} is a recording already; copy the file")
    recording = _LinkRecording(config, hashlib.sha256(config_path.read_bytes()).hexdigest(), options)
    with recording.open() as arrived:
        recording.wait(arrived, options.seconds)
    recording.check(options.seconds)
    return recording.result()


class _LinkRecording:
    """One recording, from its beginning to its end."""

    def __init__(self, config: Config, config_sha256: str, options: RecordOptions) -> None:
        boot_id = secrets.token_hex(8)
        self._recorder = Recorder(options.place, origin(config, config.name, boot_id, config_sha256))
        self._pipeline = _pipeline(config, boot_id, self._recorder) if options.derived else None
        self._arrived = threading.Event()
        self._reader = BoardReader(
            config.link, config.plate, self._arrived.set, step_frames=(64,), on_event=self._recorder.put
        )
        self._board: BoardOnline | None = None
        self._link = ""  # what was said of it last
        self._first_frame_s: float | None = None
        self._ended_s = 0.0
        self._stopped = False

    @contextmanager
    def open(self) -> Iterator[threading.Event]:
        """Give what is set whenever something arrives; the file has its end afterwards."""
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        handlers = {number: signal.signal(number, self._stop) for number in numbers}
        try:
            self._reader.start()
            yield self._arrived
        finally:
            self._ended_s = time.monotonic()
            self._reader.stop()
            self._measure_the_rest()
            self._recorder.close()
            is_kept = self._reader.counters().frames > 0
            if not is_kept:
                self._recorder.path.unlink(missing_ok=True)  # it would only be in the way of the next attempt
            for number, handler in handlers.items():
                signal.signal(number, handler)
            if is_kept:
                self._say_progress(end="\n")
            elif sys.stderr.isatty():
                sys.stderr.write("\r\x1b[K")  # no line of a file that is gone

    def wait(self, arrived: threading.Event, seconds: float | None) -> None:
        begun_s = said_s = time.monotonic()
        while not self._stopped and self._recorder.failure is None:
            arrived.wait(_TURN_S)
            arrived.clear()
            self._take()
            now_s = time.monotonic()
            if self._first_frame_s is None:
                if now_s - begun_s > _OPEN_S:
                    raise NoBoardError(f"no board counts after {_OPEN_S:g} s: {self._link}")
            elif seconds is not None and now_s - self._first_frame_s >= seconds:
                return
            if now_s - said_s >= _PROGRESS_S:
                said_s = now_s
                self._say_progress()

    def check(self, seconds: float | None) -> None:
        """Raise what is wrong with a recording that has ended; `seconds` is what was asked for."""
        if self._recorder.failure is not None:
            raise RecordingEndedError(self._recorder.failure)
        told = self.result()
        if seconds is not None and self._stopped and told["seconds"] < seconds:
            if not told["frames"]:
                raise InterruptedCommandError("interrupted before a frame came; no file is kept")
            words = f"{told['seconds']:.1f} of {seconds:g} s are recorded, which stay"
            raise InterruptedCommandError(f"interrupted: {words}", told)
        if not told["frames"]:
            raise NoBoardError(f"no frame was recorded: {self._link}")

    def result(self) -> dict[str, Any]:
        account = self._reader.counters()
        counts = self._recorder.counts
        return {
            "file": str(self._recorder.path),
            "file_bytes": counts.file_bytes,
            "files": counts.files,
            "board": self._board.identity.serial_number if self._board is not None else None,
            "seconds": 0.0 if self._first_frame_s is None else round(self._ended_s - self._first_frame_s, 3),
            "bytes_received": account.bytes_received,
            "frames": account.frames,
            "frames_lost": asdict(account.lost),
            "connections": account.connections,
            "events_missing": counts.events_missing,
            "messages": counts.messages,
            "messages_missing": counts.messages_missing,
        }

    def _stop(self, *_: object) -> None:
        self._stopped = True

    def _take(self) -> None:
        for arrival in self._reader.pop_arrivals():
            if self._pipeline is not None:
                self._pipeline.handle(arrival)
            match arrival:
                case BoardOnline():
                    self._recorder.name_board(arrival)
                    self._board = arrival
                case SingleToneFrame() | ChannelisedFrame() if self._first_frame_s is None:
                    self._first_frame_s = arrival.gate_middle.monotonic_ns * 1e-9
                case LinkChange():
                    self._link = arrival.reason
                case BoardRefused():
                    raise IncompatibleBoardError(*arrival.problems)
                case ReaderFailed():
                    raise RecordingEndedError(f"the reader failed: {arrival.error!r}") from arrival.error

    def _measure_the_rest(self) -> None:
        """Measure what came before the reader stopped: its bytes are in the file."""
        if self._pipeline is not None:
            for arrival in self._reader.pop_arrivals():
                self._pipeline.handle(arrival)

    def _say_progress(self, end: str = "") -> None:
        line = _progress(self._reader.counters(), self._recorder)
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{line}\x1b[K{end}")
        elif end:
            sys.stderr.write(line + end)
        sys.stderr.flush()


def _pipeline(config: Config, boot_id: str, recorder: Recorder) -> "BoardPipeline":
    """Return what measures, and has it recorded; what that imports takes half a second."""
    from resonator_daemon.daemon.recorded_messages import RecordedMessages
    from resonator_daemon.pipeline.board_pipeline import BoardPipeline

    messages = RecordedMessages(recorder.publish, derived=True)
    return BoardPipeline(config, boot_id, messages.record)


def _progress(account: LinkCounters, recorder: Recorder) -> str:
    counts = recorder.counts
    line = f"{recorder.path}: {account.frames} frames, {account.lost.total} lost, {counts.file_bytes / 1e6:.1f} MB"
    if counts.files > 1:
        line += f", file {counts.files}"
    return line + (f", {counts.events_missing} events too many for the disk" if counts.events_missing else "")
