"""Tables as Parquet: one file each, a row group for each batch."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from resonator_daemon.errors import UserError
from resonator_daemon.exporting.columns import Column, Value
from resonator_daemon.exporting.table_output import Batch
from resonator_daemon.host.new_file import NewFile
from resonator_daemon.publishing.topics import Topic

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise UserError("Parquet needs pyarrow: pip install pyarrow") from error

_TYPES: Final = {
    "int64": pa.int64(),
    "uint64": pa.uint64(),
    "float64": pa.float64(),
    "bool": pa.bool_(),
    "text": pa.string(),
}


class ParquetFormat:
    """Files with a type, unit and description for each column, compressed by zstd.

    What is missing is null, a number that is not known is NaN. Arrays are lists of fixed size, row by row; the column's
    metadata have their shape.

    Parameters
    ----------
    place
        Gives the file of a topic.
    metadata
        Of each file.
    """

    def __init__(self, place: Callable[[str], Path], metadata: Mapping[str, str]) -> None:
        self._place = place
        self._metadata = metadata
        self._new: list[NewFile] = []
        self._files: list[_ParquetFile] = []

    def open_table(self, topic: Topic[Any], columns: Sequence[Column]) -> "_ParquetFile":
        new = NewFile(self._place(topic.path))
        self._new.append(new)
        file = _ParquetFile(new, columns, {**self._metadata, "topic": topic.path})
        self._files.append(file)
        return file

    def close(self) -> Mapping[str, int]:
        for file in self._files:
            file.close()
        return {str(new.path): new.keep() for new in self._new}

    def discard(self) -> None:
        for file in self._files:
            file.discard()
        for new in self._new:
            new.discard()


class _ParquetFile:
    def __init__(self, new: NewFile, columns: Sequence[Column], metadata: Mapping[str, str]) -> None:
        self._schema = pa.schema([_field(column) for column in columns], metadata=dict(metadata))
        self._writer = pq.ParquetWriter(new.file, self._schema, compression="zstd")

    def write(self, batch: Batch) -> None:
        arrays = [_array(values, field.type) for values, field in zip(batch, self._schema, strict=True)]
        self._writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))

    def close(self) -> None:
        self._writer.close()

    def discard(self) -> None:
        with suppress(OSError):  # it would try when it is collected, and have no file
            self._writer.close()


def _field(column: Column) -> Any:
    metadata = {"description": column.description, "unit": column.unit}
    if column.shape:
        metadata["shape"] = json.dumps(column.shape)
        kind = pa.list_(pa.float32(), math.prod(column.shape))
    else:
        kind = _TYPES[column.kind]
    return pa.field(column.name, kind, column.nullable, {key: text for key, text in metadata.items() if text})


def _array(values: Sequence[Value], kind: Any) -> Any:
    if not pa.types.is_fixed_size_list(kind):
        return pa.array(values, kind, from_pandas=False)
    missing = np.array([value is None for value in values])
    filled = np.zeros((len(values), kind.list_size), np.float32)
    for row, value in zip(filled, values, strict=True):
        if isinstance(value, np.ndarray):
            row[:] = value.ravel()
    return pa.FixedSizeListArray.from_arrays(filled.ravel(), kind.list_size, mask=pa.array(missing))
