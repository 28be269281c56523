"""The computer itself: its clock, the room on its disk, and the systemd unit that starts the daemon."""

import ctypes
import errno
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.board.config.tables import Recording
from resonator_daemon.board.recording.file_series import Series
from resonator_daemon.tools.doctor.finding import Amount, Area, Check, Finding
from resonator_daemon.tools.doctor.host import Host

SOURCE: Final = Check("clock.source", Area.SOFTWARE, "clock source")
DATE: Final = Check("clock.date", Area.SOFTWARE, "date")
SYNCHRONISED: Final = Check("clock.synchronised", Area.SOFTWARE, "time synchronisation")

_SLOW_SOURCES: Final = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
_CURRENT: Final = "/sys/devices/system/clocksource/clocksource0/current_clocksource"
_OLDEST_UTC_S: Final = datetime(2025, 1, 1, tzinfo=UTC).timestamp()  # no computer that runs this is older
_TIMEX_BYTES: Final = 208  # struct timex of 64-bit Linux; this much is enough for all others
_TIME_ERROR: Final = 5  # what adjtimex returns of a clock that is not synchronised

STATE: Final = Check("disk.state", Area.SOFTWARE, "space for state")
RECORDINGS: Final = Check("disk.recordings", Area.SOFTWARE, "space for recordings")
BUDGET: Final = Check("disk.budget", Area.SOFTWARE, "budget of recordings")

_STATE_MB: Final = 50.0
_MB: Final = 1e6

UNIT: Final = Check("service.unit", Area.SOFTWARE, "systemd unit")
RULES: Final = Check("service.rules", Area.SOFTWARE, "udev rules")

_UNIT: Final = "resonatord@.service"
_UNIT_PLACES: Final = ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")
_RULE_PLACES: Final = ("/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
_CONFIGURATIONS: Final = Path("/etc/resonatord")


class _Room(NamedTuple):
    free_mb: float
    trouble: str  # why nothing can be written, empty where it can


def check_disk(state_directory: Path, recording: Recording | None, name: str | None) -> Iterator[Finding]:
    """Yield whether there is room where a daemon writes.

    Parameters
    ----------
    state_directory
        Of the daemon.
    recording
        None: without a configuration nothing is recorded.
    name
        Of the daemon, which its recordings have; None where only the board has it: then none of them are known.
    """
    yield _judge(STATE, state_directory, _STATE_MB, "what waits for a broker is kept in memory alone")
    if recording is None:
        return
    yield _judge(RECORDINGS, recording.directory, float(recording.min_free_mb), "nothing is recorded")
    yield _budget(recording, name)


def _judge(check: Check, directory: Path, needed_mb: float, consequence: str) -> Finding:
    room = _room(directory)
    if room.trouble:
        return check.fault(
            f"{directory}: {room.trouble}: {consequence}", "name another directory, or make this one writable"
        )
    figures = f"{directory}: {room.free_mb:.0f} MB are free, {needed_mb:g} MB are needed"
    if room.free_mb >= needed_mb:
        return check.ok(figures, Amount(room.free_mb, needed_mb, "MB"))
    return check.fault(
        f"{figures}: {consequence}", "free space on it, or choose another disk", Amount(room.free_mb, needed_mb, "MB")
    )


def _budget(recording: Recording, name: str | None) -> Finding:
    room = _room(recording.directory)
    if room.trouble:
        return BUDGET.not_checked("the directory cannot be written")
    taken_mb = _taken_mb(recording.directory, name) if name is not None else 0.0
    attainable_mb = room.free_mb + taken_mb - recording.min_free_mb
    evidence = (
        f"recordings may take {recording.max_total_mb:g} MB; with the {taken_mb:.0f} MB they take now, the disk has "
        f"{max(attainable_mb, 0.0):.0f} MB for them"
    )
    if attainable_mb >= recording.max_total_mb:
        return BUDGET.ok(evidence, Amount(float(recording.max_total_mb), attainable_mb, "MB"))
    return BUDGET.warning(
        f"{evidence}: it is full before the oldest recordings give way",
        "lower recording.max_total_mb, or name a larger disk",
        Amount(float(recording.max_total_mb), attainable_mb, "MB"),
    )


def _room(directory: Path) -> _Room:
    """Return the room in a directory, or in the nearest one above that exists: it is made when it is needed."""
    place = directory
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        return _Room(0.0, f"{place} is a file")
    try:
        with tempfile.TemporaryFile(dir=place):  # permissions do not show a read-only file system
            pass
        system = os.statvfs(place)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        return _Room(0.0, f"cannot be written ({meaning_of(error)})" if not full else "the disk is full")
    return _Room(system.f_bavail * system.f_frsize / _MB, "")


def _taken_mb(directory: Path, name: str) -> float:
    """Return what a daemon's own recordings take: others do not give way to it."""
    sizes = []
    for file in Series(directory, name).files() if directory.is_dir() else ():
        try:
            sizes.append(file.stat().st_size)
        except OSError:
            continue  # it gave way meanwhile
    return sum(sizes) / _MB


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


def check_service(config_path: Path | None, host: Host) -> Iterator[Finding]:
    """Yield whether unit and rules are installed; a configuration that is run by hand needs neither."""
    if not host.at("/run/systemd/system").is_dir():
        yield UNIT.not_checked("no systemd runs here")
        return
    if config_path is None or config_path.absolute().parent != _CONFIGURATIONS:
        yield UNIT.not_checked(f"the configuration is not in {_CONFIGURATIONS}: it is run by hand")
        return
    unit = next((place for place in _UNIT_PLACES if host.at(f"{place}/{_UNIT}").exists()), None)
    if unit is None:
        yield UNIT.warning(f"{_UNIT} is not installed: nothing starts the daemon", "sudo resonatord install")
        return
    yield UNIT.ok(f"{unit}/{_UNIT}")
    rules = [file for place in _RULE_PLACES for file in host.at(place).glob("*resonator*.rules")]
    if rules:
        yield RULES.ok(", ".join(file.name for file in rules))
    else:
        yield RULES.warning("none is installed: the board starts no daemon", "sudo resonatord install")
