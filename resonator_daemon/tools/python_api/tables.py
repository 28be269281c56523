"""Tables of a recording: NumPy arrays with units, and the same for pandas and xarray."""

import re
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.errors import ExitCode, MissingLibraryError, UserError
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.base.plate import Plate
from resonator_daemon.mqtt.payload_types import AXES
from resonator_daemon.mqtt.topics import CONTACTS, DECODED_SUMMARY
from resonator_daemon.tools.export.tables import Column

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_NUMBERED: Final = re.compile(r"(?P<before>(?:\w+_)?)(?P<kind>site|channel)_(?P<number>\d+)_(?P<key>\w+)")
_ROW_PER_ITEM: Final = (CONTACTS.path, DECODED_SUMMARY.path)
_SIGNAL_ROWS: Final = ("p_n", "eps_xz", "eps_yz")
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
        plate: Plate,
        attributes: Mapping[str, str],
    ) -> None:
        self.topic = topic
        self.columns = columns
        self._arrays = arrays
        self._plate = plate
        self._attributes = {"topic": topic, **attributes}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name in self._arrays:
            return self._arrays[name]
        raise NoColumnError(f"column {name!r}: the table of {self.topic!r} has none of this name; {self._near(name)}")

    def _near(self, name: str) -> str:
        """Return what columns there are, sites and channels as one, and the nearest name."""
        kinds = dict.fromkeys(re.sub(r"(site|channel)_\d+_", r"\1_N_", column) for column in self)
        sites = [int(found["number"]) for column in self if (found := _NUMBERED.fullmatch(column))]
        numbers = f" (N from {min(sites)} to {max(sites)})" if sites else ""
        near = get_close_matches(name, list(self), n=1)
        return f"it has {', '.join(kinds)}{numbers}{f'; did you mean {near[0]}?' if near else ''}"

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
        of `signals` or `decoded` may hold a whole array; `to_xarray` suits these better.

        Raises
        ------
        MissingLibraryError
            pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise _missing("pandas") from None
        time = pd.DatetimeIndex(self.time, name="time").tz_localize("UTC")
        frame = pd.DataFrame({name: self._series(name, pd) for name in self}, copy=False)
        frame.index = time
        units = {name: column.unit for name, column in self.columns.items() if column.unit}
        frame.attrs = {**self._attributes, "units": units}
        return frame

    def to_xarray(self) -> "xr.Dataset":
        """Return a Dataset in which sites, channels and places are dimensions.

        `site_7_force_newton` becomes `site_force_newton` along `time` and `site`; maps are along `time`, `component`,
        `y` and `x` with places in metres. Tables with several rows for a message, as `contacts`, have the dimension
        `row` in place of `time`. Each variable has `units` and `description`. Whole numbers that are missing are NaN.

        Raises
        ------
        MissingLibraryError
            xarray is not installed.
        """
        try:
            import xarray as xr
        except ImportError:
            raise _missing("xarray") from None
        rows = "row" if self.topic in _ROW_PER_ITEM else "time"
        coordinates: dict[str, Any] = {"time": (rows, self.time)}
        variables: dict[str, Any] = {}
        folded: dict[tuple[str, str], list[tuple[int, str]]] = {}
        for name, column in self.columns.items():
            if match := _NUMBERED.fullmatch(name):
                key = (match["kind"], f"{match['before']}{match['kind']}_{match['key']}")
                folded.setdefault(key, []).append((int(match["number"]), name))
            else:
                dimensions = (rows, *self._dimensions(column, coordinates))
                variables[name] = (dimensions, _filled(self[name]), _described(column))
        for (kind, name), members in folded.items():
            coordinates[kind] = (kind, [number for number, _ in members])
            array = np.stack([_filled(self[member]) for _, member in members], axis=1)
            variables[name] = ((rows, kind), array, _described(self.columns[members[0][1]]))
        if "site" in coordinates:
            x_m, y_m = self._plate.site_positions_m.T
            coordinates |= {"site_x_m": ("site", x_m, {"units": "m"}), "site_y_m": ("site", y_m, {"units": "m"})}
        return xr.Dataset(variables, coordinates, self._attributes)

    def _series(self, name: str, pd: Any) -> Any:
        array, column = self._arrays[name], self.columns[name]
        if column.shape:
            return pd.Series(list(array), dtype=object)
        if isinstance(array, np.ma.MaskedArray):
            series = pd.Series(array.data, dtype=_PANDAS_COUNTS[column.data_type])
            series[np.ma.getmaskarray(array)] = pd.NA
            return series
        if column.data_type == "text":
            words, codes = np.unique(array, return_inverse=True)
            missing = int(column.nullable and "" in words)  # sorted: it would be the first
            return pd.Categorical.from_codes(codes - missing, words[missing:])
        return pd.Series(array)

    def _dimensions(self, column: Column, coordinates: dict[str, Any]) -> tuple[str, ...]:
        """Return the dimensions of a column's arrays; add their coordinates."""
        if not column.shape:
            return ()
        first = "signal" if self.topic == "signals" else "component"
        coordinates[first] = (first, list(_SIGNAL_ROWS if first == "signal" else AXES))
        if len(column.shape) == 2:
            coordinates["site"] = ("site", self._plate.site_ids)
            return (first, "site")
        pitch_m = self["grid_pitch_m"][0]
        for axis, count in (("y", column.shape[1]), ("x", column.shape[2])):
            places_m = self[f"grid_origin_{axis}_m"][0] + pitch_m * np.arange(count)
            coordinates[axis] = (axis, places_m, {"units": "m"})
        return (first, "y", "x")


def _filled(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array without a mask: masked whole numbers become NaN if there are any."""
    if not isinstance(array, np.ma.MaskedArray):
        return array
    missing = np.ma.getmaskarray(array)
    return np.where(missing, np.nan, array.data) if missing.any() else array.data


def _described(column: Column) -> dict[str, str]:
    return {key: text for key, text in (("units", column.unit), ("description", column.description)) if text}


def _missing(library: str) -> MissingLibraryError:
    return MissingLibraryError(f"{library} is not installed: {how_to_install(library)}")
