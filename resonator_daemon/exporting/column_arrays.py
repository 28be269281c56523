"""Values of a column as arrays of numbers: text by its number, what is missing as NaN, 0 or False."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.exporting.columns import Column, Value

_DTYPES: Final = {
    "int64": "<i8",
    "uint64": "<u8",
    "float64": "<f8",
    "bool": "|b1",
    "float32 array": "<f4",
    "text": "<u4",  # the number of the text
}


class ColumnEncoder:
    """Encoder of one column, batch after batch.

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
