"""Whether this computer was too busy meanwhile for what it saw of times to be the link's, or the broker's, doing."""

from typing import Final

from resonator_daemon.doctor.host import Host

_IDLE_LEAST: Final = 0.15  # of all processors' time: below that, programs wait for each other
_IDLE_FIELDS: Final = (3, 4)  # of /proc/stat: idle, and idle while a disk is waited for
_ALL_FIELDS: Final = 8  # those after count time of guests a second time


class Load:
    """The processors' load from its making on."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._idle_begun, self._all_begun = self._counts()

    def busy(self) -> str:
        """Return that the computer was busy, as a sentence; empty where it was not, or does not tell."""
        idle, counted = self._counts()
        elapsed = counted - self._all_begun
        if elapsed <= 0:
            return ""
        share = (idle - self._idle_begun) / elapsed
        if share >= _IDLE_LEAST:
            return ""
        return (
            f"this computer is busy: its processors are idle {100 * max(share, 0.0):.0f} % of the time, at least "
            f"{100 * _IDLE_LEAST:.0f} % are needed to judge by"
        )

    def _counts(self) -> tuple[int, int]:
        words = (self._host.text("/proc/stat") or "").partition("\n")[0].split()[1 : _ALL_FIELDS + 1]
        if len(words) < _ALL_FIELDS or not all(word.isdecimal() for word in words):
            return 0, 0
        counts = [int(word) for word in words]
        return sum(counts[field] for field in _IDLE_FIELDS), sum(counts)
