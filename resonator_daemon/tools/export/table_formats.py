"""Tables as text, as an archive of NumPy arrays, and in memory."""

import csv
import io
import tempfile
import zipfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Final

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


_DTYPES: Final = {
    "int64": "<i8",
    "uint64": "<u8",
    "float64": "<f8",
    "bool": "|b1",
    "float32 array": "<f4",
    "text": "<u4",  # the number of the text
}


class ColumnEncoder:
    """Encoder of one column, batch after batch: text by its number, what is missing as NaN, 0 or False.

    Attributes
    ----------
    dtype : numpy.dtype
        Of the arrays.
    texts : dict of str to int, or None
        Number of each text so far, the empty one where it is missing; None for numbers.
    """

    def __init__(self, column: Column) -> None:
        self.dtype = np.dtype(_DTYPES[column.data_type])
        self.texts: dict[str, int] | None = {} if column.data_type == "text" else None
        self._shape = column.shape

    def encode(self, values: Sequence[Value]) -> NDArray[Any]:
        """Return an array of shape (n, ...) for n values."""
        array: NDArray[Any] = np.zeros((len(values), *self._shape), self.dtype)
        if self.texts is not None:
            words = ("" if value is None else str(value) for value in values)
            array[:] = [self.texts.setdefault(word, len(self.texts)) for word in words]
            return array
        if np.issubdtype(self.dtype, np.floating):
            array[...] = np.nan
        for index, value in enumerate(values):
            if value is not None:
                array[index] = value
        return array


_PIECE_ROWS: Final = 1 << 10
_COMPRESSION: Final = 1  # the fastest: most columns hardly change


class NpzFormat(TableOutput):
    """One archive for all topics; until it is made, columns wait next to it on the disk, uncompressed.

    A number that is not known, or missing, is NaN; text that is missing is empty. A whole number or truth value that
    may be missing has next to it a column of its name and `_known`. The metadata are arrays of one text each,
    `metadata/KEY`.
    """

    def begin(self) -> None:
        super().begin()
        self._tables: list[_ArchivedTable] = []
        self._waiting = ExitStack()
        self._archive = self._new_file().file
        prefix = f".{self._path.name}."
        made = tempfile.TemporaryDirectory(prefix=prefix, suffix=".columns", dir=self._path.parent)
        self._folder = Path(self._waiting.enter_context(made))

    def open_table(self, topic: str, columns: Sequence[Column]) -> "_ArchivedTable":
        folder = self._folder / str(len(self._tables))
        folder.mkdir()
        self._tables.append(_ArchivedTable(topic, columns, folder))
        return self._tables[-1]

    def finish(self) -> None:
        super().finish()
        with zipfile.ZipFile(self._archive, "w", zipfile.ZIP_DEFLATED, compresslevel=_COMPRESSION) as archive:
            for key, text in self._recorded.metadata.items():
                with archive.open(f"metadata/{key}.npy", "w") as member:
                    np.lib.format.write_array(member, np.array(text), allow_pickle=False)
            for table in self._tables:
                table.write_into(archive)
        self._waiting.close()

    def discard(self) -> None:
        self._waiting.close()
        super().discard()


class _ArchivedTable:
    """The columns of one topic, each a file of bytes, and next to it, where values may be missing, which are known."""

    def __init__(self, topic: str, columns: Sequence[Column], folder: Path) -> None:
        self._files: list[tuple[int, bool, _ColumnFile]] = []  # number of the column, and whether it has what is known
        for number, column in enumerate(columns):
            name = f"{topic}/{column.name}"
            self._files.append((number, False, _ColumnFile(name, column, folder / str(number))))
            if column.nullable and column.counts:
                known = _ColumnFile(f"{name}_known", Column("", "bool"), folder / f"{number}.known")
                self._files.append((number, True, known))

    def write(self, batch: Batch) -> None:
        for number, is_known, file in self._files:
            file.append([value is not None for value in batch[number]] if is_known else batch[number])

    def write_into(self, archive: zipfile.ZipFile) -> None:
        for _, _, file in self._files:
            file.write_into(archive)


class _ColumnFile:
    """The bytes of one column; of text, which needs a width, the number of each text."""

    def __init__(self, name: str, column: Column, place: Path) -> None:
        self._name = name
        self._place = place
        self._encoder = ColumnEncoder(column)
        self._shape = column.shape
        self._rows = 0

    def append(self, values: Sequence[Value]) -> None:
        self._rows += len(values)
        with self._place.open("ab") as file:
            file.write(self._encoder.encode(values).tobytes())

    def write_into(self, archive: zipfile.ZipFile) -> None:
        texts = None if self._encoder.texts is None else np.array(list(self._encoder.texts))
        dtype = self._encoder.dtype if texts is None else texts.dtype
        shape = (self._rows, *self._shape)
        header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        piece_bytes = _PIECE_ROWS * self._encoder.dtype.itemsize
        with archive.open(f"{self._name}.npy", "w", force_zip64=True) as member, self._place.open("rb") as file:
            np.lib.format.write_array_header_2_0(member, header)
            while data := file.read(piece_bytes):
                member.write(data if texts is None else texts[np.frombuffer(data, self._encoder.dtype)].tobytes())
        self._place.unlink()


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
