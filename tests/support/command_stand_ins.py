"""Substitute for the parts of a daemon that commands use; it lists the calls."""

import math
import re
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from example_messages import example

from resonator_daemon.base.errors import UserError
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.tables import Measurement
from resonator_daemon.board.recording.file_series import Series
from resonator_daemon.board.recording.reader import Origin
from resonator_daemon.board.recording.recorder import RecordingCounts
from resonator_daemon.board.recording.switch import NothingRecordedError
from resonator_daemon.board.recording.writer import Contents
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.daemon.service.command_handlers import CommandHandlers
from resonator_daemon.daemon.service.recordings import RecordingCommands
from resonator_daemon.measure.pipeline.control_requests import Control, Tare
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.event_file import EventFileError
from resonator_daemon.mqtt.event_log import EventPage, UnknownRunError
from resonator_daemon.mqtt.payloads import Condition, ContactEvent
from resonator_daemon.mqtt.topics import CONTACTS, FORCES, Topic

BOOT_ID = "9f3c"
RECORDING_NAME = re.compile(r"left-\d{8}T\d{6}\.\d{3}Z(-[A-Za-z0-9_-]{1,64})?\.mcap")


class StandIn:
    """Sensor, recording and publisher in one; `acts` has the calls that change something."""

    def __init__(self, directory: Path) -> None:
        self.acts: list[tuple[Any, ...]] = []
        self.directory = directory
        self.touched: str | None = None
        self.measurement = Measurement()
        self.ready = True
        self.link = SimpleNamespace(state=Condition.ONLINE)
        self.board_refuses: str | None = None
        self.disk_problem = ""
        self.streams: tuple[Topic[Any], ...] = (FORCES, CONTACTS)
        self.current: SimpleNamespace | None = None

    @property
    def common_mode(self) -> tuple[float, ...]:
        return (1e-6, math.nan, math.nan, math.nan)

    @property
    def sensor(self) -> "StandIn":
        return self

    def answers_for(self, _boot_id: str | None) -> bool:
        return True

    def blink(self, done: Callable[[str | None], None]) -> None:
        self.acts.append(("locate",))
        done(self.board_refuses)

    async def stored_events(self, boot_id: str | None, after_seq: int, bytes_max: int) -> EventPage:
        if boot_id == "unreadable":
            raise EventFileError("another process holds the file")
        if boot_id not in (None, BOOT_ID):
            raise UnknownRunError(boot_id)
        event = example(ContactEvent)
        events = (event.model_copy(update={"seq": seq}) for seq in range(max(after_seq + 1, 7), 10))
        return EventPage(tuple(encode(event) for event in events), after_seq >= 6, 7, 9)

    async def apply(self, request: Control) -> str | None:
        if isinstance(request, Tare):
            self.acts.append(("tare",))
            return self.touched
        measurement = request.measurement
        if not 0 < measurement.step_ms <= measurement.window_ms:
            raise ValueError(f"step of {measurement.step_ms} and window of {measurement.window_ms} ms")
        self.measurement = measurement
        self.acts.append(("measure_over", measurement.window_ms, measurement.step_ms))
        return None

    def start(self, series: Series, _origin: Origin) -> None:
        series.directory.mkdir(parents=True, exist_ok=True)
        path = series.path(time.time_ns())
        if path.parent != self.directory or not RECORDING_NAME.fullmatch(path.name):
            raise ValueError(f"{path} is no place for a recording")
        self.acts.append(("start", path))
        if self.disk_problem:
            raise UserError(f"{path} cannot be written: {self.disk_problem}")
        self.current = SimpleNamespace(path=path, since=HostTime(0, 1789000000000000000, 0), failure=None)

    def stop(self) -> SimpleNamespace | None:
        self.acts.append(("stop",))
        ended, self.current = self.current, None
        if ended is not None:
            counts = RecordingCounts(files=1, events_missing=1)
            vars(ended).update(counts=counts, written=Contents(events=20), all_bytes=1000, seconds=2.5)
        return ended

    def mark(self, text: str) -> int:
        if self.current is None or self.current.failure is not None:
            raise NothingRecordedError("nothing is being recorded")
        self.acts.append(("mark", text))
        return 1789000000000000001


def handlers_on(stand_in: StandIn, config: Config) -> CommandHandlers:
    """Return the handlers of a daemon called "left"."""
    parts = dict.fromkeys(("pipeline", "publisher", "daemon", "reader", "requests"), stand_in)
    recording = RecordingCommands(config, "left", stand_in)  # type: ignore[arg-type]
    return CommandHandlers(config, BOOT_ID, recording, **parts)  # type: ignore[arg-type]


def configured(directory: Path, link: str = "tcp://127.0.0.1:5000") -> Config:
    return Config.model_validate({"plate": "quartz16", "link": link, "recording": {"directory": str(directory)}})
