"""Tables of a recording: NumPy arrays with units, and the same for pandas."""

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.errors import ExitCode, MissingLibraryError, UserError
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.tools.export.tables import Column

if TYPE_CHECKING:
    import pandas as pd

_PANDAS_COUNTS: Final = {"int64": "Int64", "uint64": "UInt64", "bool": "boolean"}


class NoColumnError(UserError, KeyError):
    """The table has no column of this name."""

    exit_code = ExitCode.USAGE
    code = "no_column"

    def __str__(self) -> str:
        return "\n".join(self.messages)  # of KeyError it has quotes


class Table(Mapping[str, NDArray[Any]]):
    """Table of one topic: a NumPy array for each column, by its name.

    Names end in the unit, as `site_7_force_newton`; `columns` has unit and meaning of each. Numbers that are not known
    are NaN, and a status states why. Where a value does not exist, as the force on a site that nothing presses, numbers
    are NaN, words are empty, and whole numbers are masked.

    Attributes
    ----------
    topic : str
        As `contacts/event`.
    columns : Mapping of str to Column
        `name`, `unit` (UCUM), `description` and `data_type` of each column.
    """

    def __init__(
        self,
        topic: str,
        columns: Mapping[str, Column],
        arrays: Mapping[str, NDArray[Any]],
        attributes: Mapping[str, str],
    ) -> None:
        self.topic = topic
        self.columns = columns
        self._arrays = arrays
        self._attributes = {"topic": topic, **attributes}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name in self._arrays:
            return self._arrays[name]
        near = get_close_matches(name, list(self), n=1)
        hint = f"did you mean {near[0]}?" if near else "`list(table)` has all names"
        raise NoColumnError(f"column {name!r}: the table of {self.topic!r} has none of this name; {hint}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    @property
    def row_count(self) -> int:
        """Number of rows."""
        return len(self._arrays["t_ns"])

    @property
    def time(self) -> NDArray[np.datetime64]:
        """UTC of each row, (rows,): the middle of what was measured, to the nanosecond."""
        return self._arrays["t_ns"].astype("datetime64[ns]")

    def __repr__(self) -> str:
        return f"<Table {self.topic!r}: {self.row_count} rows, {len(self)} columns>"

    def to_pandas(self) -> "pd.DataFrame":
        """Return a DataFrame with the same columns; its index `time` is UTC.

        Words are categories; what is missing is NaN or NA. `frame.attrs["units"]` has the unit of each column. A cell
        of `signals` or `decoded` holds a whole array.

        Raises
        ------
        MissingLibraryError
            pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise MissingLibraryError(f"pandas is not installed: {how_to_install('pandas')}") from None
        time = pd.DatetimeIndex(self.time, name="time").tz_localize("UTC")
        frame = pd.DataFrame({name: self._series(name, pd) for name in self}, copy=False)
        frame.index = time
        units = {name: column.unit for name, column in self.columns.items() if column.unit}
        frame.attrs = {**self._attributes, "units": units}
        return frame

    def _series(self, name: str, pd: Any) -> Any:
        array, column = self._arrays[name], self.columns[name]
        if column.shape:
            return pd.Series(list(array), dtype=object)
        if isinstance(array, np.ma.MaskedArray):
            return pd.array(array.tolist(), _PANDAS_COUNTS[column.data_type])
        if column.data_type == "text":
            return pd.Categorical([word or None for word in array] if column.nullable else array)
        return array
