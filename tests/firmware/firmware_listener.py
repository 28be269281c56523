"""The daemon's reader of one board, and everything that it has handed on."""

import threading
import time
from collections.abc import Callable

from resonator_daemon.acquisition.board import BoardReader
from resonator_daemon.acquisition.frames import Arrival, BoardOnline, Gap, LinkChange, SingleToneFrame
from resonator_daemon.config import SerialLink, TcpLink
from resonator_daemon.plate import load_plate

DEADLINE_S = 60.0  # far beyond what any of this takes: it ends a test that hangs


class Listener:
    """Arrivals in order."""

    def __init__(self, link: SerialLink | TcpLink) -> None:
        self._woken = threading.Event()
        self.reader = BoardReader(link, load_plate("quartz16"), self._woken.set)
        self.arrivals: list[Arrival] = []

    def __enter__(self) -> "Listener":
        self.reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.stop()

    def wait_for(self, enough: Callable[[], bool]) -> None:
        """Take arrivals until there are enough."""
        deadline = time.monotonic() + DEADLINE_S
        while not enough():
            assert time.monotonic() < deadline, self.states
            self._woken.wait(1.0)
            self._woken.clear()
            self.arrivals += self.reader.take()

    def wait_for_frames(self, more: int) -> None:
        wanted = len(self.frames) + more
        self.wait_for(lambda: len(self.frames) >= wanted)

    @property
    def frames(self) -> list[SingleToneFrame]:
        return [arrival for arrival in self.arrivals if isinstance(arrival, SingleToneFrame)]

    @property
    def gaps(self) -> list[Gap]:
        return [arrival for arrival in self.arrivals if isinstance(arrival, Gap)]

    @property
    def boards(self) -> list[BoardOnline]:
        return [arrival for arrival in self.arrivals if isinstance(arrival, BoardOnline)]

    @property
    def states(self) -> list[tuple[str, str]]:
        return [(arrival.state, arrival.reason) for arrival in self.arrivals if isinstance(arrival, LinkChange)]

    def check_accounts(self) -> None:
        """Every byte has its fate; every index is a frame or in a gap, in order and once."""
        account = self.reader.account()
        fates = account.bytes_accepted + account.bytes_other_version + account.bytes_own_direction
        assert account.bytes_received == fates + account.bytes_discarded + account.bytes_waiting
        index = 0
        for arrival in self.arrivals:
            if isinstance(arrival, Gap):
                assert arrival.first_index == index
                index += arrival.loss.total
            elif isinstance(arrival, SingleToneFrame):
                assert arrival.index == index
                index += 1
