"""Recordings as episodes of a LeRobotDataset: one frame for each reading, and masked frames in place of lost ones."""

from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import UsageError
from resonator_daemon.base.host.files import NoNewFileError
from resonator_daemon.base.host.text import print_note
from resonator_daemon.board.config import Config
from resonator_daemon.extensions.lerobot.dataset import INFO_FILE, Dataset, RecordingWriter
from resonator_daemon.extensions.lerobot.features import (
    COMPARED,
    PROVENANCE_KEY,
    SINGLES,
    Values,
    describe,
    frames_a_second,
    values_of,
)
from resonator_daemon.mqtt.codec import decoded
from resonator_daemon.mqtt.payloads import Forces, Info, Measured, Message, Signals
from resonator_daemon.mqtt.topics import CONTACTS, DECODED, FORCES, INFO, SIGNALS, Topic
from resonator_daemon.tools.export.output import Output
from resonator_daemon.tools.export.run import file_metadata
from resonator_daemon.tools.replay.recorded_pipeline import Moment

_END_MARK: Final = "end"
_ANOTHER: Final = "name another directory"


class Format(Output):
    """A directory, to which later exports add the recordings that are not in it yet.

    A recording without marks is one episode, whose task is the name of its file. Else each mark begins an episode until
    the next one; its text is the task, except that a mark `end` begins none. A gap of more than 60 s begins an episode.
    """

    available = (FORCES.path, DECODED.path, SIGNALS.path, CONTACTS.path)
    kept = "complete recordings are kept; repeat the command to add the others"
    _dataset: Dataset
    _writer: RecordingWriter | None = None
    _values: Values | None = None  # of the present reading, at `_t_ns`

    @classmethod
    def check(cls, path: Path, topics: tuple[str, ...]) -> None:
        if not path.is_dir():
            super().check(path, topics)
        elif any(path.iterdir()) and not ((info := path / INFO_FILE).is_file() and PROVENANCE_KEY in info.read_text()):
            raise NoNewFileError(f"{path} has files and is no dataset of resonatord; {_ANOTHER}")

    def begin(self) -> None:
        stated = describe(self._recorded.config, self._topics)
        if len(stated["features"]) == len(SINGLES):
            raise UsageError(f"--topics: plate {self._recorded.plate.name} has none of {', '.join(self._topics)}")
        self._dataset = Dataset(self._path, stated)
        self._dataset.publish()

    def start(self, path: Path, span: str, config: Config) -> bool:
        self.finish()
        self._recording, self._marked = path, False
        self._check(describe(config, self._topics))
        self._source = file_metadata(path, config) | {"span": span.strip()}
        if (self._source["source_sha256"], self._source["span"]) in self._dataset.sources:
            print_note(f"{path}: is in the dataset already")
            self.rows["episodes"] += 0  # something was asked for, and is there
            return False
        self._writer = RecordingWriter(self._dataset, self._source)
        self._writer.begin_episode(path.stem)
        return True

    def add(self, moment: Moment) -> None:
        if moment.mark is not None and self._writer is not None:
            if not self._marked:
                self._writer.discard()
                self._writer = RecordingWriter(self._dataset, self._source)
            self._marked = True
            self._writer.begin_episode(None if moment.mark == _END_MARK else moment.mark)
        for topic, message in moment.messages:
            if topic.path in (*self.available, INFO.path):  # also those that --topics leaves out
                self.put(topic, decoded(topic.payload, message), moment.now.utc_ns)
        self._end_reading()

    def put(self, topic: Topic[Any], message: Message, now_ns: int) -> None:
        match message:
            case Info():
                self._check({"fps": frames_a_second(message.step_s)})
            case Forces() | Signals() if message.board_ticks is not None:
                self._end_reading()
                self._t_ns, self._values = message.t_ns, {}
                self._board_s = message.board_ticks / self._recorded.plate.counter.reference_hz
        if self._values is not None and isinstance(message, Measured) and message.t_ns == self._t_ns:
            self._values |= values_of(message, self._recorded.plate)

    def finish(self) -> None:
        if self._writer is not None:
            self.rows.update(self._writer.finish())
            self._writer = None
            self._dataset.publish()

    def close(self) -> dict[str, int]:
        self.finish()
        self._dataset.release()
        size_bytes = sum(file.stat().st_size for file in self._path.rglob("*.*"))
        return {str(self._path): size_bytes} if self._dataset.episodes else {}

    def discard(self) -> None:
        if self._writer is not None:
            self._writer.discard()
        if hasattr(self, "_dataset"):
            self._dataset.release()

    def _check(self, stated: dict[str, Any]) -> None:
        """Check that the recording belongs into the dataset: same plate, calibration, rate and features."""
        for key, value in stated.items():
            there = self._dataset.info[key]
            if key == PROVENANCE_KEY:
                value, there = ({name: one[name] for name in COMPARED} for one in (value, there))
            if value != there:
                words = f"{value}, the dataset has {there}" if key != "features" else "other ones than those"
                raise UsageError(f"{self._recording}: {key}: {words} in {self._path}; {_ANOTHER}")

    def _end_reading(self) -> None:
        if self._values is not None and self._writer is not None:
            self._writer.add(self._t_ns, self._board_s, self._values)
        self._values = None
