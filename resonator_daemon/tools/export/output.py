"""The interface of the formats: from the moments of a recording to files that are complete or absent."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from resonator_daemon.base.host.files import NewFile
from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config import Config
from resonator_daemon.mqtt.codec import decoded
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import Topic
from resonator_daemon.tools.export.tables import WITH_TABLE
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
    rows : Counter
        Number of rows or messages written, by topic.
    """

    available: ClassVar[tuple[str, ...]] = WITH_TABLE
    file_per_topic: ClassVar[bool] = False

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

    @abstractmethod
    def begin(self) -> None:
        """Make the files that do not depend on the messages."""

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
