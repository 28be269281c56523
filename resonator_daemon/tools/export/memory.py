"""Tables in memory, one array for each column: what the Python package loads."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.mqtt.topics import TOPICS
from resonator_daemon.tools.export.columns import Column, ColumnEncoder, Value
from resonator_daemon.tools.export.output import Recorded
from resonator_daemon.tools.export.table_output import Batch, TableOutput
from resonator_daemon.tools.export.tables import WITH_ARRAYS, make_table


class MemoryOutput(TableOutput):
    """Output that stays in memory.

    Attributes
    ----------
    tables : dict of str to MemoryTable
        By topic; from `begin` on.
    """

    def __init__(self, topics: tuple[str, ...], recorded: Recorded) -> None:
        super().__init__(Path(), topics, recorded)

    def begin(self) -> None:
        super().begin()
        self.tables: dict[str, MemoryTable] = {}

    def open_table(self, topic: str, columns: Sequence[Column]) -> "MemoryTable":
        self.tables[topic] = MemoryTable(columns)
        return self.tables[topic]

    def finish(self) -> None:
        """Store the last rows; a topic without messages has a table without rows, unless it has arrays."""
        super().finish()
        for topic in self._topics:
            if topic not in self.tables and topic not in WITH_ARRAYS:
                self.open_table(topic, make_table(TOPICS[topic], self._recorded.plate, None).columns)


class MemoryTable:
    """Columns of one topic.

    Parameters
    ----------
    columns
        In their order.
    """

    def __init__(self, columns: Sequence[Column]) -> None:
        self._columns = [_MemoryColumn(column) for column in columns]

    @property
    def columns(self) -> dict[str, Column]:
        """Columns by name."""
        return {each.column.name: each.column for each in self._columns}

    def write(self, batch: Batch) -> None:
        for column, values in zip(self._columns, batch, strict=True):
            column.append(values)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the array of each column: text as words, counts that may be missing as masked arrays."""
        return {each.column.name: each.array() for each in self._columns}


class _MemoryColumn:
    def __init__(self, column: Column) -> None:
        self.column = column
        self._encoder = ColumnEncoder(column)
        self._pieces = [self._encoder.encode(())]
        self._missing = [np.zeros(0, np.bool_)]

    def append(self, values: Sequence[Value]) -> None:
        self._pieces.append(self._encoder.encode(values))
        self._missing.append(np.array([value is None for value in values], np.bool_))

    def array(self) -> NDArray[Any]:
        numbers = np.concatenate(self._pieces)
        if self._encoder.texts is not None:
            words = np.array([*self._encoder.texts, ""], object)  # each text once in memory
            return np.take(words, numbers)
        if self.column.counts and self.column.nullable:
            return np.ma.MaskedArray(numbers, np.concatenate(self._missing))
        return numbers
