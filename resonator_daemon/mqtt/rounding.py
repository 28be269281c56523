"""Numbers rounded to a hundredth of their standard deviation: further digits are noise."""

import math

_DIGITS = 2  # of the standard deviation: a unit in the last place is at most a hundredth of it


def rounded(value: float, std: float) -> float:
    """Return `value` to a hundredth of its standard deviation or better, unchanged where that is not known."""
    places = _places(std)
    return value if places is None else round(value, places)


def rounded_std(std: float) -> float:
    """Return a standard deviation, or another number of its own scale, to three digits."""
    places = _places(abs(std))
    return std if places is None else round(std, places)


def _places(std: float) -> int | None:
    return _DIGITS - math.floor(math.log10(std)) if 0.0 < std < math.inf else None
