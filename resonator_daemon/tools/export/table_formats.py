"""Tables as text, and as NumPy arrays in memory."""

import csv
import io
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.mqtt.topics import TOPICS
from resonator_daemon.tools.export.output import Batch, Recorded, TableOutput
from resonator_daemon.tools.export.tables import WITH_ARRAYS, WITH_TABLE, Column, Value, make_table


class CsvFormat(TableOutput):
    """Files of lines, UTF-8, as RFC 4180 has them but for the ends of lines, which are those of Unix.

    Numbers have as many digits as bring them back exactly; one that is not known is `nan`, what is missing is empty.
    """

    available = tuple(path for path in WITH_TABLE if path not in WITH_ARRAYS)
    file_per_topic = True

    def open_table(self, topic: str, columns: Sequence[Column]) -> "_CsvFile":
        return _CsvFile(self._new_file(topic).file, [column.name for column in columns])


class _CsvFile:
    def __init__(self, file: IO[bytes], names: Sequence[str]) -> None:
        self._file = file
        self._write([names])

    def write(self, batch: Batch) -> None:
        self._write(zip(*batch, strict=True))

    def _write(self, rows: Iterable[Sequence[Value]]) -> None:
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([_text(value) for value in row] for row in rows)
        self._file.write(text.getvalue().encode())


def _text(value: Value) -> object:
    """Return what the writer turns into the text of a value: of an enumeration its value, of a truth value a word."""
    if isinstance(value, bool):
        return str(value).lower()
    return str(value) if isinstance(value, str) else value


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
    """Columns of one topic, in their order."""

    def __init__(self, columns: Sequence[Column]) -> None:
        self.columns = {column.name: column for column in columns}
        self._pieces = [[_array(column, ())] for column in columns]

    def write(self, batch: Batch) -> None:
        for column, pieces, values in zip(self.columns.values(), self._pieces, batch, strict=True):
            pieces.append(_array(column, values))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the array of each column: text as words, counts that may be missing as masked arrays."""
        return {
            name: (np.ma.concatenate if isinstance(pieces[0], np.ma.MaskedArray) else np.concatenate)(pieces)
            for name, pieces in zip(self.columns, self._pieces, strict=True)
        }


def _array(column: Column, values: Sequence[Value]) -> NDArray[Any]:
    """Return the values (n, ...) of a column: what is missing is NaN, an empty text, or masked."""
    if column.data_type == "text":  # each in memory once
        return np.array([sys.intern("" if value is None else str(value)) for value in values], object)
    if column.shape:
        array = np.full((len(values), *column.shape), np.nan, np.float32)
        for row, value in zip(array, values, strict=True):
            row[...] = np.nan if value is None else value
        return array
    if column.counts and column.nullable:
        missing = [value is None for value in values]
        known = [0 if value is None else value for value in values]
        return np.ma.MaskedArray(known, missing, column.data_type)
    return np.array(values, column.data_type)
