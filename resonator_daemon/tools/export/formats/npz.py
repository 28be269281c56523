"""Tables as an archive of NumPy arrays, one for each column: `numpy.load(FILE)["forces/t_ns"]`."""

import tempfile
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np

from resonator_daemon.tools.export.columns import Column, ColumnEncoder, Value
from resonator_daemon.tools.export.table_output import Batch, TableOutput

_PIECE_ROWS: Final = 1 << 10
_COMPRESSION: Final = 1  # the fastest: most columns hardly change


class Format(TableOutput):
    """One archive for all topics; until it is made, columns wait next to it on the disk, uncompressed.

    A number that is not known, or missing, is NaN; text that is missing is empty. A whole number or truth value that
    may be missing has next to it a column of its name and `_known`. The metadata are arrays of one text each,
    `metadata/KEY`.
    """

    def begin(self) -> None:
        super().begin()
        self._tables: list[_Table] = []
        self._waiting = ExitStack()
        self._archive = self._new_file().file
        prefix = f".{self._path.name}."
        made = tempfile.TemporaryDirectory(prefix=prefix, suffix=".columns", dir=self._path.parent)
        self._folder = Path(self._waiting.enter_context(made))

    def open_table(self, topic: str, columns: Sequence[Column]) -> "_Table":
        folder = self._folder / str(len(self._tables))
        folder.mkdir()
        self._tables.append(_Table(topic, columns, folder))
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


class _Table:
    """The columns of one topic, each a file of bytes."""

    def __init__(self, topic: str, columns: Sequence[Column], folder: Path) -> None:
        self._columns = [
            _ColumnFile(f"{topic}/{column.name}", column, folder / str(number)) for number, column in enumerate(columns)
        ]
        self._known = [
            _ColumnFile(f"{file.name}_known", Column("", "bool"), file.place.with_suffix(".known"))
            if column.nullable and column.counts
            else None
            for file, column in zip(self._columns, columns, strict=True)
        ]

    def write(self, batch: Batch) -> None:
        for file, known, values in zip(self._columns, self._known, batch, strict=True):
            file.append(values)
            if known is not None:
                known.append([value is not None for value in values])

    def write_into(self, archive: zipfile.ZipFile) -> None:
        for file in (*self._columns, *filter(None, self._known)):
            file.write_into(archive)


class _ColumnFile:
    """The bytes of one column; of text, which needs a width, the number of each text."""

    def __init__(self, name: str, column: Column, place: Path) -> None:
        self.name = name
        self.place = place
        self._encoder = ColumnEncoder(column)
        self._shape = column.shape
        self._rows = 0

    def append(self, values: Sequence[Value]) -> None:
        self._rows += len(values)
        with self.place.open("ab") as file:
            file.write(self._encoder.encode(values).tobytes())

    def write_into(self, archive: zipfile.ZipFile) -> None:
        texts = None if self._encoder.texts is None else np.array(list(self._encoder.texts))
        dtype = self._encoder.dtype if texts is None else texts.dtype
        shape = (self._rows, *self._shape)
        header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        piece_bytes = _PIECE_ROWS * self._encoder.dtype.itemsize
        with archive.open(f"{self.name}.npy", "w", force_zip64=True) as member, self.place.open("rb") as file:
            np.lib.format.write_array_header_2_0(member, header)
            while data := file.read(piece_bytes):
                member.write(data if texts is None else texts[np.frombuffer(data, self._encoder.dtype)].tobytes())
        self.place.unlink()
