"""The computer's clock: what it counts by, whether it is set, and whether it follows a time server."""

import ctypes
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Final

from resonator_daemon.doctor.finding import Area, Check, Finding
from resonator_daemon.doctor.host import Host

SOURCE: Final = Check("clock.source", Area.SOFTWARE, "clock source")
DATE: Final = Check("clock.date", Area.SOFTWARE, "date")
SYNCHRONISED: Final = Check("clock.synchronised", Area.SOFTWARE, "time synchronisation")

_SLOW_SOURCES: Final = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
_CURRENT: Final = "/sys/devices/system/clocksource/clocksource0/current_clocksource"
_OLDEST_UTC_S: Final = datetime(2025, 1, 1, tzinfo=UTC).timestamp()  # no computer that runs this is older
_TIMEX_BYTES: Final = 208  # struct timex of 64-bit Linux; this much is enough for all others
_TIME_ERROR: Final = 5  # what adjtimex returns of a clock that is not synchronised


def is_synchronised() -> bool | None:
    """Ask the kernel whether somebody keeps its clock; None where it may not be asked."""
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.create_string_buffer(2 * _TIMEX_BYTES))
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != _TIME_ERROR


def check_clock(
    host: Host, now_s: Callable[[], float] = time.time, synchronised: Callable[[], bool | None] = is_synchronised
) -> Iterator[Finding]:
    """Yield the findings on the computer's clock."""
    yield _source(host)
    utc_s = now_s()
    date = datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d")
    if utc_s < _OLDEST_UTC_S:
        yield DATE.fault(
            f"the computer takes today for {date}: messages bear that time, and certificates count as not valid yet",
            "set the clock (sudo timedatectl set-ntp true, or date -s), and see to the battery of the clock",
        )
    else:
        yield DATE.ok(date)
    match synchronised():
        case None:
            yield SYNCHRONISED.not_checked("the kernel does not report it")
        case True:
            yield SYNCHRONISED.ok("the kernel's clock is kept by a time server")
        case False:
            yield SYNCHRONISED.warning(
                "nobody keeps the kernel's clock: times do not agree with those of other computers",
                "sudo timedatectl set-ntp true, or install chrony; without a network nothing is to be done",
            )


def _source(host: Host) -> Finding:
    source = host.text(_CURRENT)
    if source is None:
        return SOURCE.not_checked("the kernel does not report it")
    if source not in _SLOW_SOURCES:
        return SOURCE.ok(source)
    return SOURCE.warning(
        f"{source}: reading the time takes microseconds, and ticks of the board are timed less well",
        "look into `dmesg | grep -i -e tsc -e clocksource` for why the processor's own counter was given up",
    )
