"""Base of the formats that are tables: turns messages into rows, and writes these in batches."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Final, Protocol

from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.topics import Topic
from resonator_daemon.tools.export.columns import Column, Value
from resonator_daemon.tools.export.output import Output
from resonator_daemon.tools.export.tables import Table, make_table

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
