"""Recording of a board's link to a file, without publishing."""

import hashlib
import secrets
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import (
    ConfigurationError,
    ExitCode,
    IncompatibleBoardError,
    InterruptedCommandError,
    UserError,
)
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.config import Config, load_config
from resonator_daemon.board.recording.recorder import Recorder
from resonator_daemon.board.session.board_reader import BlockingReader
from resonator_daemon.board.session.frames import (
    Arrival,
    BoardOnline,
    BoardRefused,
    ChannelisedFrame,
    LinkChange,
    ReaderFailed,
    SingleToneFrame,
)
from resonator_daemon.board.session.link_events import WireEvent
from resonator_daemon.daemon.service.recordings import origin

_TURN_S: Final = 0.2


class NoBoardError(UserError):
    """No board sends frames on the link."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_board"


class PortInUseError(NoBoardError):
    """Another program holds the link."""

    code = ReasonCode.PORT_IN_USE


class RecordingEndedError(UserError):
    """The file takes no more, or the reader failed."""

    exit_code = ExitCode.FAILED
    code = "ended"


@dataclass(frozen=True)
class RecordOptions:
    """What to record to which file; None is no bound.

    Parameters
    ----------
    output
        The file.
    seconds
        From the first frame on.
    open_s
        Time in which a board must count.
    progress_s
        Period of the progress line.
    """

    output: Path
    seconds: float | None = None
    open_s: float = 10.0
    progress_s: float = 1.0


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
    with recording.open():
        recording.wait(options)
    recording.check(options.seconds)
    return recording.result()


class _LinkRecording:
    """One recording, from its beginning to its end."""

    def __init__(self, config: Config, config_sha256: str, options: RecordOptions) -> None:
        boot_id = secrets.token_hex(4)
        self._recorder = Recorder(options.output, origin(config, config.name, boot_id, config_sha256), needs_frame=True)
        self._loop = BlockingReader(config.link, config.plate, step_frames=(64,), on_event=self._put)
        self._frames_counted = 0
        self._board: BoardOnline | None = None
        self._link = ""  # its last reason
        self._first_frame_s: float | None = None
        self._ended_s = 0.0
        self._stopped = False

    @contextmanager
    def open(self) -> Iterator[None]:
        """Read the board, and end the file afterwards."""
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        handlers = {number: signal.signal(number, self._stop) for number in numbers}
        try:
            with self._loop:
                yield
                self._ended_s = time.monotonic()
        finally:
            self._recorder.close()
            is_kept = self._recorder.written.frames > 0 and self._recorder.path.exists()
            if not is_kept and self._recorder.path.is_file():
                self._recorder.path.unlink()  # it would only be in the way of the next attempt
            for number, handler in handlers.items():
                signal.signal(number, handler)
            if is_kept:
                self._print_progress(end="\n")
            elif sys.stderr.isatty():
                sys.stderr.write("\r\x1b[K")  # no line of a file that is gone

    def wait(self, options: RecordOptions) -> None:
        """Record until the time is over, a signal comes, or the file takes no more."""
        begun_s = printed_s = time.monotonic()
        while not self._stopped and self._recorder.failure is None:
            for arrival in self._loop.wait(_TURN_S):
                self._handle(arrival)
            now_s = time.monotonic()
            if self._first_frame_s is None:
                if now_s - begun_s > options.open_s:
                    raise NoBoardError(f"no board sends frames after {options.open_s:g} s: {self._link}")
            elif options.seconds is not None and now_s - self._first_frame_s >= options.seconds:
                return
            if now_s - printed_s >= options.progress_s:
                printed_s = now_s
                self._print_progress()

    def check(self, seconds: float | None) -> None:
        """Raise what is wrong with a recording that has ended; `seconds` is what was asked for."""
        result = self.result()
        if self._recorder.failure is not None:
            raise RecordingEndedError(self._recorder.failure.text, partial_result=result)
        if self._stopped and not result["frames"]:
            raise InterruptedCommandError("interrupted before a frame came; no file is kept")
        if seconds is not None and self._stopped and result["seconds"] < seconds:
            words = f"{result['seconds']:.1f} of {seconds:g} s are recorded, which stay"
            raise InterruptedCommandError(f"interrupted: {words}", partial_result=result)
        if not result["frames"]:
            raise NoBoardError(f"no frame was recorded: {self._link}")

    def result(self) -> dict[str, Any]:
        counters = self._loop.reader.counters()
        counts = self._recorder.counts
        return {
            "file": str(self._recorder.path),
            "file_bytes": counts.file_bytes,
            "board": self._board.identity.serial_number if self._board is not None else None,
            "seconds": 0.0 if self._first_frame_s is None else round(self._ended_s - self._first_frame_s, 3),
            "bytes_received": counters.bytes_received,
            "frames": self._recorder.written.frames,
            "frames_lost": asdict(counters.lost),
            "connections": counters.connections,
            "events_missing": counts.events_missing,
        }

    def _put(self, event: WireEvent) -> None:
        """Record an event, and count the frames of those before it."""
        frames = self._loop.reader.machine.frames
        self._recorder.put(event, frames - self._frames_counted)
        self._frames_counted = frames

    def _stop(self, *_: object) -> None:
        self._stopped = True

    def _handle(self, arrival: Arrival) -> None:
        match arrival:
            case BoardOnline():
                self._recorder.name_board(arrival)
                self._board = arrival
            case SingleToneFrame() | ChannelisedFrame() if self._first_frame_s is None:
                self._first_frame_s = arrival.gate_middle.monotonic_ns * 1e-9
            case LinkChange():
                self._link = arrival.reason.text
                if arrival.reason.code is ReasonCode.PORT_IN_USE and self._first_frame_s is None:
                    raise PortInUseError(self._link)  # at once: the other program goes on for as long as it likes
            case BoardRefused():
                raise IncompatibleBoardError(*(problem.text for problem in arrival.problems))
            case ReaderFailed():
                raise RecordingEndedError(f"the reader failed: {arrival.error!r}") from arrival.error

    def _print_progress(self, end: str = "") -> None:
        recorder, lost, counts = self._recorder, self._loop.reader.machine.lost.total, self._recorder.counts
        line = f"{recorder.path}: {recorder.written.frames} frames, {lost} lost, {counts.file_bytes / 1e6:.1f} MB"
        line += f", {counts.events_missing} events too many for the disk" if counts.events_missing else ""
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{line}\x1b[K{end}")
        elif end:
            sys.stderr.write(line + end)
        sys.stderr.flush()
