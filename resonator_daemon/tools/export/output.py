"""The interface of the formats: from the moments of a recording to files that are complete or absent.

One is given messages, or, if its files are tables, batches of their rows.
"""

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Protocol

from resonator_daemon.base.host.files import NewFile, check_new
from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config import Config
from resonator_daemon.mqtt.codec import decoded
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import Topic
from resonator_daemon.tools.export.tables import WITH_TABLE, Column, Table, Value, make_table
from resonator_daemon.tools.replay.recorded_pipeline import Moment


@dataclass(frozen=True)
class Recorded:
    """Data of a recording for its formats: the configuration, and metadata of its files."""

    config: Config
    metadata: Mapping[str, str]

    @property
    def plate(self) -> Plate:
        return self.config.plate

    @property
    def name(self) -> str:
        """Name that the plate was published under."""
        return self.config.name or self.plate.name


class Output(ABC):
    """Files of one format; `begin` makes what is needed from the start, `close` or `discard` must follow.

    Parameters
    ----------
    path
        Named output.
    topics
        Paths of the topics to be exported.
    recorded
        Recording that is exported.

    Attributes
    ----------
    available : tuple of str
        Paths of the topics that the format can have.
    file_per_topic : bool
        Whether each topic has a file of its own.
    kept : str
        What remains of an export that fails; empty if all is removed.
    rows : Counter
        Number of rows or messages written, by topic.
    """

    available: ClassVar[tuple[str, ...]] = WITH_TABLE
    file_per_topic: ClassVar[bool] = False
    kept: ClassVar[str] = ""

    def __init__(self, path: Path, topics: tuple[str, ...], recorded: Recorded) -> None:
        self._path = path
        self._topics = topics
        self._recorded = recorded
        self._files: list[NewFile] = []
        self.rows: Counter[str] = Counter()

    @classmethod
    def place(cls, path: Path, topics: tuple[str, ...], topic: str) -> Path:
        """Return the file of a topic: the named output, or one next to it where there are many."""
        if not cls.file_per_topic or len(topics) == 1:
            return path
        return path.with_name(f"{path.stem}-{topic.replace('/', '-')}{path.suffix}")

    @classmethod
    def check(cls, path: Path, topics: tuple[str, ...]) -> None:
        """Check that the output can be made; NoNewFileError if not."""
        for topic in topics:
            check_new(cls.place(path, topics, topic))

    @abstractmethod
    def begin(self) -> None:
        """Make the files that do not depend on the messages."""

    def start(self, path: Path, span: str, config: Config) -> bool:
        """Begin a recording, or the span of it in words; return whether its moments are needed."""
        return True

    def add(self, moment: Moment) -> None:
        """Write the messages of a moment."""
        for topic, message in moment.messages:
            if topic.path in self._topics:
                self.put(topic, decoded(topic.payload, message), moment.now.utc_ns)

    @abstractmethod
    def put(self, topic: Topic[Any], message: Message, now_ns: int) -> None:
        """Write one message; `now_ns` is when it was published (UTC)."""

    @abstractmethod
    def finish(self) -> None:
        """Write what is left into the files."""

    def close(self) -> dict[str, int]:
        """Complete the files; return the size in bytes of each."""
        self.finish()
        return {str(file.path): file.keep() for file in self._files}

    def discard(self) -> None:
        """Remove what there is of the files."""
        for file in self._files:
            file.discard()

    def _new_file(self, topic: str = "") -> NewFile:
        file = NewFile(self.place(self._path, self._topics, topic))
        self._files.append(file)
        return file


BATCH_BYTES: Final = 8 << 20  # of numbers; Python holds them in about four times as much
_SCALAR_BYTES: Final = 8

Batch = Sequence[Sequence[Value]]
"""A sequence of values for each column, all of one length."""


class TableFile(Protocol):
    """The file, or part of a file, that has one table."""

    def write(self, batch: Batch) -> None: ...


class TableOutput(Output):
    """Output of tables, one for each topic.

    Attributes
    ----------
    batch_bytes : int
        Size of the numbers that are written at once.
    """

    batch_bytes = BATCH_BYTES

    def begin(self) -> None:
        self._open: dict[str, _OpenTable] = {}

    @abstractmethod
    def open_table(self, topic: str, columns: Sequence[Column]) -> TableFile:
        """Begin the table of a topic."""

    def put(self, topic: Topic[Any], message: Message, now_ns: int) -> None:
        path = topic.path
        if path not in self._open:
            table = make_table(topic, self._recorded.plate, message)
            self._open[path] = _OpenTable(table, self.open_table(path, table.columns), self.batch_bytes)
        self.rows[path] += self._open[path].add(message)

    def finish(self) -> None:
        for table in self._open.values():
            table.flush()


class _OpenTable:
    """A table that is being written."""

    def __init__(self, table: Table, file: TableFile, batch_bytes: int) -> None:
        self._table = table
        self._file = file
        row_bytes = sum(4 * math.prod(column.shape) if column.shape else _SCALAR_BYTES for column in table.columns)
        self._batch_rows = max(1, batch_bytes // row_bytes)
        self._waiting: list[Sequence[Value]] = []

    def add(self, message: Message) -> int:
        """Add the rows of a message; return how many."""
        rows = list(self._table.rows(message))
        self._waiting += rows
        if len(self._waiting) >= self._batch_rows:
            self.flush()
        return len(rows)

    def flush(self) -> None:
        if self._waiting:
            self._file.write(list(zip(*self._waiting, strict=True)))
            self._waiting.clear()
