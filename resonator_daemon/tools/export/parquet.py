"""Tables as Parquet: one file each, a row group for each batch."""

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

import numpy as np

from resonator_daemon.base.errors import MissingLibraryError
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.tools.export.output import Batch, TableOutput
from resonator_daemon.tools.export.tables import Column, Value

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise MissingLibraryError(f"Parquet needs pyarrow: {how_to_install('pyarrow')}") from error

_TYPES: Final = {
    "int64": pa.int64(),
    "uint64": pa.uint64(),
    "float64": pa.float64(),
    "bool": pa.bool_(),
    "text": pa.string(),
}


class ParquetFormat(TableOutput):
    """Files with a type, unit and description for each column, compressed by zstd.

    What is missing is null, a number that is not known is NaN. Arrays are lists of fixed size, row by row; the column's
    metadata have their shape.
    """

    file_per_topic = True

    def begin(self) -> None:
        super().begin()
        self._tables: list[_ParquetFile] = []

    def open_table(self, topic: str, columns: Sequence[Column]) -> "_ParquetFile":
        metadata = {**self._recorded.metadata, "topic": topic}
        schema = pa.schema([_field(column) for column in columns], metadata=metadata)
        # No value of a map occurs twice: with a dictionary, maps take a third more bytes and four times as long.
        repeated = [column.name for column in columns if not column.shape]
        writer = pq.ParquetWriter(self._new_file(topic).file, schema, compression="zstd", use_dictionary=repeated)
        table = _ParquetFile(writer, schema)
        self._tables.append(table)
        return table

    def finish(self) -> None:
        super().finish()
        for table in self._tables:
            table.writer.close()

    def discard(self) -> None:
        for table in self._tables:
            with suppress(OSError):  # it would try when it is collected, and have no file
                table.writer.close()
        super().discard()


class _ParquetFile:
    def __init__(self, writer: Any, schema: Any) -> None:
        self.writer = writer
        self._schema = schema

    def write(self, batch: Batch) -> None:
        arrays = [_array(values, field.type) for values, field in zip(batch, self._schema, strict=True)]
        self.writer.write_table(pa.Table.from_arrays(arrays, schema=self._schema))


def _field(column: Column) -> Any:
    metadata = {"description": column.description, "unit": column.unit}
    if column.shape:
        metadata["shape"] = json.dumps(column.shape)
        kind = pa.list_(pa.float32(), math.prod(column.shape))
    else:
        kind = _TYPES[column.data_type]
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
