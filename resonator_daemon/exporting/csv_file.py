"""Tables as text: one file each, a line of names and then a line for each row."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from resonator_daemon.exporting.columns import Column, Value
from resonator_daemon.exporting.table_output import Batch
from resonator_daemon.host.new_file import NewFile
from resonator_daemon.publishing.topics import Topic


class CsvFormat:
    """Files of lines, UTF-8, as RFC 4180 has them but for the ends of lines, which are those of Unix.

    Numbers have as many digits as bring them back exactly; one that is not known is `nan`, what is missing is empty.

    Parameters
    ----------
    place
        Gives the file of a topic.
    """

    def __init__(self, place: Callable[[str], Path]) -> None:
        self._place = place
        self._files: list[NewFile] = []

    def open_table(self, topic: Topic[Any], columns: Sequence[Column]) -> "_CsvFile":
        new = NewFile(self._place(topic.path))
        self._files.append(new)
        return _CsvFile(new, [column.name for column in columns])

    def close(self) -> Mapping[str, int]:
        return {str(new.path): new.keep() for new in self._files}

    def discard(self) -> None:
        for new in self._files:
            new.discard()


class _CsvFile:
    def __init__(self, new: NewFile, names: Sequence[str]) -> None:
        self._file = new.file
        self._write([names])

    def write(self, batch: Batch) -> None:
        self._write(zip(*batch, strict=True))

    def _write(self, rows: Any) -> None:
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([_text(value) for value in row] for row in rows)
        self._file.write(text.getvalue().encode())


def _text(value: Value) -> object:
    """Return what csv writes as it should be: words without the class that they are of."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return str(value) if isinstance(value, str) else value
