"""Days of moments in UTC."""

from datetime import date
from typing import Final

DAY_NS: Final = 86_400 * 10**9
_EPOCH_DAY: Final = date(1970, 1, 1).toordinal()


def utc_day(utc_ns: int) -> date:
    """Return the day of a moment, in UTC."""
    return date.fromordinal(_EPOCH_DAY + utc_ns // DAY_NS)
