"""Tables as text: one file each, a line of names and then a line for each row."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import IO

from resonator_daemon.tools.export.columns import Column, Value
from resonator_daemon.tools.export.table_output import Batch, TableOutput
from resonator_daemon.tools.export.tables import WITH_ARRAYS, WITH_TABLE


class Format(TableOutput):
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
