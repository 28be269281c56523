"""Writes tables to files of their format as they come, a batch of rows at a time."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

from resonator_daemon.exporting.columns import Column, Value
from resonator_daemon.exporting.tables import Table, make_table
from resonator_daemon.plate import Plate
from resonator_daemon.publishing.topics import Topic
from resonator_daemon.replay.recorded_pipeline import Moment

_BATCH_BYTES: Final = 8 << 20  # of numbers; Python holds them in about four times as much
_SCALAR_BYTES: Final = 8

Batch = Sequence[Sequence[Value]]
"""A sequence of values for each column, all of one length."""


class TableFile(Protocol):
    """Takes the rows of one table."""

    def write(self, batch: Batch) -> None: ...


class TableFormat(Protocol):
    """Makes files of tables."""

    def open_table(self, topic: Topic[Any], columns: Sequence[Column]) -> TableFile: ...
    def close(self) -> Mapping[str, int]:
        """Make the files whole; returns the size in bytes of each."""
        ...

    def discard(self) -> None:
        """Remove what there is of them."""
        ...


class TableOutput:
    """Turns the messages of chosen topics into rows, and hands these on.

    Parameters
    ----------
    output
        Takes them.
    topics
        Paths of those to be exported.
    plate
        Of the recording.

    Attributes
    ----------
    rows : dict
        How many, by topic.
    """

    def __init__(self, output: TableFormat, topics: Sequence[str], plate: Plate) -> None:
        self._output = output
        self._topics = frozenset(topics)
        self._plate = plate
        self._open: dict[str, _Open] = {}

    @property
    def rows(self) -> dict[str, int]:
        return {path: table.rows for path, table in self._open.items()}

    def take(self, moment: Moment) -> None:
        for topic, message in moment.messages:
            if topic.path not in self._topics:
                continue
            if topic.path not in self._open:
                table = make_table(topic, self._plate, message)
                self._open[topic.path] = _Open(table, self._output.open_table(topic, table.columns))
            self._open[topic.path].take(message)

    def close(self) -> Mapping[str, int]:
        for table in self._open.values():
            table.flush()
        return self._output.close()

    def discard(self) -> None:
        self._output.discard()


class _Open:
    """A table that is being written."""

    def __init__(self, table: Table, file: TableFile) -> None:
        self._table = table
        self._file = file
        row_bytes = sum(_bytes(column) for column in table.columns)
        self._batch_rows = max(1, _BATCH_BYTES // row_bytes)
        self._waiting: list[Sequence[Value]] = []
        self.rows = 0

    def take(self, message: Any) -> None:
        self._waiting += self._table.rows(message)
        if len(self._waiting) >= self._batch_rows:
            self.flush()

    def flush(self) -> None:
        if self._waiting:
            self.rows += len(self._waiting)
            self._file.write(list(zip(*self._waiting, strict=True)))
            self._waiting.clear()


def _bytes(column: Column) -> int:
    return 4 * math.prod(column.shape) if column.shape else _SCALAR_BYTES
