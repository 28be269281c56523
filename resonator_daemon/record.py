"""`resonatord record`: writes what happens on a board's link to a file, without measuring or publishing anything."""

import json
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from resonator_daemon.acquisition.account import LinkAccount
from resonator_daemon.acquisition.board import BoardReader
from resonator_daemon.acquisition.frames import (
    BoardOnline,
    BoardRefused,
    ChannelisedFrame,
    LinkChange,
    ReaderFailed,
    SingleToneFrame,
)
from resonator_daemon.acquisition.recording import Recorder
from resonator_daemon.config import Config, ReplayLink, load_config
from resonator_daemon.errors import ConfigError, ExitCode, IncompatibleBoardError, OperatorError

_OPEN_S: Final = 10.0  # in which a board must count
_TURN_S: Final = 0.2
_PROGRESS_S: Final = 1.0


class NoBoardError(OperatorError):
    """No board counts on the link."""

    exit_code = ExitCode.UNAVAILABLE


class RecordingEndedError(OperatorError):
    """The file takes no more, or the reader failed."""

    exit_code = ExitCode.FAILED


_CODES: Final[dict[type[OperatorError], str]] = {
    NoBoardError: "no_board",
    IncompatibleBoardError: "refused",
    RecordingEndedError: "ended",
}


def record(config_path: Path, output: Path, seconds: float | None, *, as_json: bool) -> None:
    """Record until the time is over or SIGINT, SIGTERM or SIGHUP comes.

    Raises
    ------
    OperatorError
        The configuration cannot be used, the file cannot be made or takes no more, or no board counts.
    """
    try:
        config = load_config(config_path)
        if isinstance(config.link, ReplayLink):
            raise ConfigError(f"link: {config.link} is a recording already; copy the file")
        sitting = _Sitting(config, output)
        with sitting.open() as arrived:
            sitting.wait(arrived, seconds)
        sitting.check()
    except OperatorError as error:
        if as_json:
            told = {"code": _CODES.get(type(error), "config"), "message": str(error), "hint": ""}
            sys.stdout.write(json.dumps({"verb": "record", "ok": False, "error": told}) + "\n")
        raise
    if as_json:
        sys.stdout.write(json.dumps({"verb": "record", "ok": True, **sitting.result()}) + "\n")


class _Sitting:
    """One recording, from its beginning to its end."""

    def __init__(self, config: Config, output: Path) -> None:
        self._output = output
        self._recorder = Recorder(output, config.plate, str(config.link))
        self._arrived = threading.Event()
        self._reader = BoardReader(
            config.link, config.plate, self._arrived.set, step_frames=(64,), tap=self._recorder.put
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
            self._recorder.close()
            if self._reader.account().frames == 0:
                self._output.unlink(missing_ok=True)  # it would only be in the way of the next attempt
            for number, handler in handlers.items():
                signal.signal(number, handler)
            self._say_progress(end="\n")

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

    def check(self) -> None:
        """Raise what is wrong with a recording that has ended."""
        if self._recorder.failure is not None:
            raise RecordingEndedError(self._recorder.failure)
        if self._reader.account().frames == 0:
            raise NoBoardError(f"no frame was recorded: {self._link}")

    def result(self) -> dict[str, Any]:
        account = self._reader.account()
        return {
            "file": str(self._output),
            "file_bytes": self._output.stat().st_size,
            "board": self._board.identity.serial_number if self._board is not None else None,
            "seconds": 0.0 if self._first_frame_s is None else round(self._ended_s - self._first_frame_s, 3),
            "bytes_received": account.bytes_received,
            "frames": account.frames,
            "frames_lost": asdict(account.lost),
            "connections": account.connections,
            "events_missing": self._recorder.skipped_events,
        }

    def _stop(self, *_: object) -> None:
        self._stopped = True

    def _take(self) -> None:
        for arrival in self._reader.take():
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

    def _say_progress(self, end: str = "") -> None:
        line = _progress(self._reader.account(), self._output, self._recorder.skipped_events)
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{line}\x1b[K{end}")
        elif end:
            sys.stderr.write(line + end)
        sys.stderr.flush()


def _progress(account: LinkAccount, output: Path, skipped_events: int) -> str:
    size = output.stat().st_size if output.exists() else 0
    line = f"{output}: {account.frames} frames, {account.lost.total} lost, {size / 1e6:.1f} MB"
    return line + (f", {skipped_events} events too many for the disk" if skipped_events else "")
