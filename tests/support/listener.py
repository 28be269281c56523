"""A running reader of a board, everything that it has handed on, and what must hold of that."""

import threading
import time
from collections.abc import Callable

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.board_reader import BoardReader
from resonator_daemon.board.session.frames import (
    Arrival,
    ChannelisedFrame,
    Gap,
    LinkChange,
    LinkCounters,
    Outage,
    SingleToneFrame,
)

QUARTZ = load_plate("quartz16")
DEADLINE_S = 60.0  # far beyond what any of this takes: it ends a test that hangs


class Arrivals:
    """What a reader of a board has handed on, by kind."""

    arrivals: list[Arrival]

    @property
    def frames(self) -> list[SingleToneFrame]:
        return [arrival for arrival in self.arrivals if isinstance(arrival, SingleToneFrame)]

    @property
    def gaps(self) -> list[Gap]:
        return [arrival for arrival in self.arrivals if isinstance(arrival, Gap)]

    @property
    def changes(self) -> list[LinkChange]:
        return [arrival for arrival in self.arrivals if isinstance(arrival, LinkChange)]

    @property
    def states(self) -> list[tuple[str, str]]:
        return [(change.state, change.reason.code) for change in self.changes]


class Listener(Arrivals):
    """A running reader and everything that it has handed on."""

    def __init__(self, link: LinkTarget, plate: object = QUARTZ, **options: object) -> None:
        self._woken = threading.Event()
        self.wakes = 0
        self.reader = BoardReader(link, plate, self._wake, **options)  # type: ignore[arg-type]
        self.arrivals = []

    def __enter__(self) -> "Listener":
        self.reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.stop()

    def _wake(self) -> None:
        self.wakes += 1
        self._woken.set()

    def wait_for(self, enough: Callable[[list[Arrival]], bool]) -> list[Arrival]:
        """Wait until there are enough arrivals; return them."""
        deadline = time.monotonic() + DEADLINE_S
        while not enough(self.arrivals):
            assert time.monotonic() < deadline, self.states
            self._woken.wait(1.0)
            self._woken.clear()
            self.arrivals += self.reader.pop_arrivals()
        return self.arrivals

    def take_the_rest(self) -> None:
        self.arrivals += self.reader.pop_arrivals()

    def wait_for_frames(self, count: int) -> None:
        self.wait_for(lambda arrivals: len(frames(arrivals)) >= count)


def frames(arrivals: list[Arrival]) -> list[SingleToneFrame | ChannelisedFrame]:
    return [arrival for arrival in arrivals if isinstance(arrival, SingleToneFrame | ChannelisedFrame)]


def gaps(arrivals: list[Arrival]) -> list[Gap]:
    return [arrival for arrival in arrivals if isinstance(arrival, Gap)]


def check_bytes(counters: LinkCounters) -> None:
    by_fate = counters.bytes_accepted + counters.bytes_other_version + counters.bytes_echo
    assert counters.bytes_received == by_fate + counters.bytes_discarded + counters.bytes_waiting


def check_indices(arrivals: list[Arrival]) -> None:
    """Every index is a frame or in a gap, in order and once."""
    expected = 0
    for arrival in arrivals:
        if isinstance(arrival, Gap):
            assert arrival.first_index == expected
            expected += arrival.loss.total
        elif isinstance(arrival, SingleToneFrame | ChannelisedFrame):
            assert arrival.index == expected
            expected += 1


def outages(arrivals: list[Arrival]) -> list[Outage]:
    return [arrival for arrival in arrivals if isinstance(arrival, Outage)]
