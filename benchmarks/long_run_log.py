"""The lines of a daemon's log, each with what may have caused it; a line without its cause is a finding."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum, auto
from typing import Final

_LATE_S: Final = 20.0  # how long after a cause a line may come: reconnections, summaries, a queue that empties


class Cause(StrEnum):
    """What was done, or goes on by itself."""

    START = auto()
    STOP = auto()
    ALWAYS = auto()  # files are full, old ones go
    GONE = auto()  # the board's port went: unplugged, killed, ended, another board
    OTHER_BOARD = auto()
    REBOOT = auto()
    BROWN_OUT = auto()
    FREEZE = auto()
    SILENCE = auto()
    TICKS = auto()
    DAMAGE = auto()
    OVERFLOW = auto()
    DELAY = auto()
    BROKER_DEAD = auto()
    BROKER_FROZEN = auto()
    GOOD_FILE = auto()
    BAD_FILE = auto()
    COMMAND = auto()
    LOAD = auto()  # other programs kept the cores busy


_BOARD: Final = (Cause.GONE, Cause.REBOOT, Cause.BROWN_OUT, Cause.FREEZE, Cause.SILENCE, Cause.TICKS, Cause.OTHER_BOARD)
_HARD: Final = (
    *_BOARD,
    Cause.DAMAGE,
    Cause.OVERFLOW,
    Cause.DELAY,
    Cause.LOAD,
)  # handshakes suffer, too
_BROKER: Final = (Cause.BROKER_DEAD, Cause.BROKER_FROZEN)

KNOWN: Final[tuple[tuple[str, tuple[Cause, ...]], ...]] = (
    (r"INFO ended by SIG(TERM|INT)", (Cause.STOP,)),
    (r"INFO metrics at http://\S+/metrics", (Cause.START,)),
    (r"INFO link starting .*", (Cause.START, *_HARD)),
    (r"INFO link online .*", (Cause.START, *_HARD)),
    (r"WARNING link waiting \(no_such_port\): .*", (Cause.START, Cause.GONE, Cause.OTHER_BOARD)),
    (r"WARNING link stalled \(no_frames\): .*", _HARD),
    (r"WARNING link lost \(unplugged\): .*", (Cause.GONE, Cause.OTHER_BOARD)),
    (r"WARNING link (waiting|stalled|lost) \(no_board_answers\): .*", _HARD),
    (r"WARNING link refused \(another_board\): .*", (Cause.OTHER_BOARD,)),
    (r"WARNING link lost \(board_restarted\): the board restarted, switched on", (Cause.GONE, Cause.OTHER_BOARD)),
    (
        r"WARNING link lost \(board_restarted\): the board restarted(, by its software)?",
        (Cause.REBOOT, Cause.BROWN_OUT),
    ),
    (r"WARNING link lost \(board_restarted\): the board restarted after a brown-out: .*", (Cause.BROWN_OUT,)),
    (r"WARNING link lost \(board_silent\): .*", _HARD),
    (r"WARNING link lost \(clock_jumped\): .*", (Cause.TICKS,)),
    (r"WARNING link lost \(port_in_use\): .*", (Cause.GONE,)),
    (r"INFO outage of \S+ s is over, \d+ frames lost: .*", _HARD),
    (r"INFO broker \S+: connected, MQTT 5", (Cause.START, *_BROKER)),
    (r"WARNING broker \S+: .*; trying again", _BROKER),
    (r"WARNING messages dropped: [^;]*", _BROKER),
    (r"INFO \S+ was removed: recordings exceeded \S+ MB", (Cause.ALWAYS,)),
    (r"INFO configuration read again: .*", (Cause.GOOD_FILE,)),
    (r"ERROR \S+\.toml\b.*", (Cause.BAD_FILE,)),
    (r"ERROR the configuration cannot be used; all goes on as before", (Cause.BAD_FILE,)),
)


@dataclass(frozen=True)
class Deed:
    """One thing that was done to the system, and until when; `inf` while it goes on."""

    cause: Cause
    from_s: float
    until_s: float


class LogJudge:
    """Log of actions and lines in their order; keeps the lines that no action explains."""

    def __init__(self, known: Iterable[tuple[str, tuple[Cause, ...]]] = KNOWN) -> None:
        self._known = [(re.compile(pattern), causes) for pattern, causes in known]
        self._deeds: list[Deed] = [Deed(Cause.ALWAYS, 0.0, float("inf"))]

    def did(self, cause: Cause, from_s: float, until_s: float) -> None:
        """Add an action; discard those that ended long ago."""
        self._deeds = [deed for deed in self._deeds if deed.until_s + 10 * _LATE_S > from_s]
        self._deeds.append(Deed(cause, from_s, until_s))

    def unexplained(self, line: str, at_s: float) -> str | None:
        """Return why a line of the log is a finding; None where a deed explains it."""
        for pattern, causes in self._known:
            if pattern.fullmatch(line):
                if any(self._at_work(cause, at_s) for cause in causes):
                    return None
                return f"{at_s:.1f} s: without a cause ({', '.join(causes)}): {line}"
        return f"{at_s:.1f} s: unknown: {line}"

    def at_work(self, causes: Iterable[Cause], at_s: float) -> bool:
        """Whether one of the causes may still show."""
        return any(self._at_work(cause, at_s) for cause in causes)

    def _at_work(self, cause: Cause, at_s: float) -> bool:
        return any(deed.cause is cause and deed.from_s <= at_s <= deed.until_s + _LATE_S for deed in self._deeds)


def new_lines(text: str) -> Iterator[str]:
    """Yield the lines of a log without control characters: boards and brokers have a say in them."""
    for line in text.splitlines():
        yield "".join(sign if sign.isprintable() else "?" for sign in line)
