"""Tables as an archive of NumPy arrays, one for each column: `numpy.load(FILE)["forces/t_ns"]`."""

import shutil
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.exporting.columns import Column, Value
from resonator_daemon.exporting.table_output import Batch
from resonator_daemon.host.new_file import NewFile
from resonator_daemon.publishing.topics import Topic

_PIECE_BYTES: Final = 1 << 20
_PIECE_TEXTS: Final = 1 << 10
_COMPRESSION: Final = 1  # the fastest: most columns hardly change
_DTYPES: Final = {"int64": "<i8", "uint64": "<u8", "float64": "<f8", "bool": "|b1"}


class NpzFormat:
    """One archive for all topics; until it is made, columns wait beside it on the disk, uncompressed.

    A number that is not known, or missing, is NaN; text that is missing is empty. A whole number or truth value that
    may be missing has beside it a column of its name and `_known`.

    Parameters
    ----------
    path
        Of the archive.
    metadata
        Goes into it as arrays of one text each, `metadata/KEY`.
    """

    def __init__(self, path: Path, metadata: Mapping[str, str]) -> None:
        self._new = NewFile(path)
        self._metadata = metadata
        self._tables: list[_Columns] = []
        try:
            self._folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".columns", dir=path.parent))
        except OSError:
            self._new.discard()
            raise

    def open_table(self, topic: Topic[Any], columns: Sequence[Column]) -> "_Columns":
        table = _Columns(topic.path, columns, self._folder / str(len(self._tables)))
        self._tables.append(table)
        return table

    def close(self) -> Mapping[str, int]:
        with zipfile.ZipFile(self._new.file, "w", zipfile.ZIP_DEFLATED, compresslevel=_COMPRESSION) as archive:
            for key, text in self._metadata.items():
                with archive.open(f"metadata/{key}.npy", "w") as member:
                    np.lib.format.write_array(member, np.array(text), allow_pickle=False)
            for table in self._tables:
                table.write_into(archive)
        shutil.rmtree(self._folder)
        return {str(self._new.path): self._new.keep()}

    def discard(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._new.discard()


class _Columns:
    """The columns of one topic, each a file of bytes."""

    def __init__(self, path: str, columns: Sequence[Column], folder: Path) -> None:
        folder.mkdir()
        self._columns = [_make(column, f"{path}/{column.name}", folder / str(n)) for n, column in enumerate(columns)]

    def write(self, batch: Batch) -> None:
        for column, values in zip(self._columns, batch, strict=True):
            column.append(values)

    def write_into(self, archive: zipfile.ZipFile) -> None:
        for column in self._columns:
            column.write_into(archive)


class _Numbers:
    """A column of numbers, or of arrays of one shape."""

    def __init__(self, name: str, dtype: str, shape: tuple[int, ...], place: Path) -> None:
        self._name = name
        self._dtype = np.dtype(dtype)
        self._shape = shape
        self._place = place
        self._rows = 0

    def append(self, values: Sequence[Value]) -> None:
        array: NDArray[Any] = np.zeros((len(values), *self._shape), self._dtype)
        if np.issubdtype(self._dtype, np.floating):
            array[...] = np.nan
        for index, value in enumerate(values):
            if value is not None:
                array[index] = value
        self._rows += len(values)
        with self._place.open("ab") as file:
            file.write(array.tobytes())

    def write_into(self, archive: zipfile.ZipFile) -> None:
        shape = (self._rows, *self._shape)
        with _member(archive, self._name, self._dtype, shape) as member, self._place.open("rb") as file:
            shutil.copyfileobj(file, member, _PIECE_BYTES)
        self._place.unlink()


class _WithGaps:
    """A column of whole numbers or truth values that may be missing, and the one that marks where they are known."""

    def __init__(self, name: str, dtype: str, place: Path) -> None:
        self._values = _Numbers(name, dtype, (), place)
        self._known = _Numbers(f"{name}_known", "|b1", (), place.with_suffix(".known"))

    def append(self, values: Sequence[Value]) -> None:
        self._values.append(values)
        self._known.append([value is not None for value in values])

    def write_into(self, archive: zipfile.ZipFile) -> None:
        self._values.write_into(archive)
        self._known.write_into(archive)


class _Text:
    """A column of text; how wide it must be is known at the end."""

    def __init__(self, name: str, place: Path) -> None:
        self._name = name
        self._place = place
        self._rows = 0
        self._width = 1

    def append(self, values: Sequence[Value]) -> None:
        texts = ["" if value is None else str(value) for value in values]
        self._rows += len(texts)
        self._width = max(self._width, *map(len, texts))
        with self._place.open("ab") as file:
            for text in texts:
                data = text.encode()
                file.write(len(data).to_bytes(4, "little") + data)

    def write_into(self, archive: zipfile.ZipFile) -> None:
        dtype = np.dtype(f"<U{self._width}")
        with _member(archive, self._name, dtype, (self._rows,)) as member, self._place.open("rb") as file:
            for first in range(0, self._rows, _PIECE_TEXTS):
                count = min(_PIECE_TEXTS, self._rows - first)
                texts = [file.read(int.from_bytes(file.read(4), "little")).decode() for _ in range(count)]
                member.write(np.array(texts, dtype).tobytes())
        self._place.unlink()


def _make(column: Column, name: str, place: Path) -> _Numbers | _WithGaps | _Text:
    match column.kind:
        case "text":
            return _Text(name, place)
        case "float32 array":
            return _Numbers(name, "<f4", column.shape, place)
    dtype = _DTYPES[column.kind]
    if column.nullable and column.kind != "float64":
        return _WithGaps(name, dtype, place)
    return _Numbers(name, dtype, (), place)


def _member(archive: zipfile.ZipFile, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> IO[bytes]:
    member = archive.open(f"{name}.npy", "w", force_zip64=True)
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_2_0(member, header)
    return member
