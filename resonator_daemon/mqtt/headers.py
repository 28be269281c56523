"""Headers of messages: number, boots of daemon and board, time, losses."""

from collections import Counter
from collections.abc import Callable
from typing import Any, TypedDict

from resonator_daemon.mqtt.payloads import Lost
from resonator_daemon.mqtt.topics import Topic


class HeaderFields(TypedDict):
    """The header that every message carries."""

    name: str
    seq: int
    daemon_boot_id: str
    t_ns: int
    t_uncertainty_ns: int
    lost: Lost


class BoardFields(HeaderFields):
    """The header of what describes the daemon with its board."""

    board_boot_id: str | None


class WindowFields(TypedDict):
    """The header of what was measured, without its number: the same for all messages about one window."""

    name: str
    daemon_boot_id: str
    t_ns: int
    t_uncertainty_ns: int
    lost: Lost
    board_ticks: int | None


class MeasuredFields(WindowFields):
    """The header of what was measured."""

    seq: int


class Headers:
    """Makes the headers of one run of the daemon; numbers the messages of each topic.

    Parameters
    ----------
    name
        Of the plate; empty where it is not known yet.
    daemon_boot_id
        Identifier of the run.
    lost
        Returns the losses as they are when a header is made.

    Attributes
    ----------
    name
        Of the plate; empty before it is known, which no message to a broker shows.
    board_boot_id
        Of the board that counts; None before there is one.
    """

    def __init__(self, name: str, daemon_boot_id: str, lost: Callable[[], Lost]) -> None:
        self.name = name
        self._daemon_boot_id = daemon_boot_id
        self.lost = lost
        self._seq: Counter[str] = Counter()
        self.board_boot_id: str | None = None

    def of(self, topic: Topic[Any], utc_ns: int) -> BoardFields:
        """Return the header of a message about a moment on the host's clock."""
        return {
            "name": self.name,
            "seq": self.next_seq(topic),
            "daemon_boot_id": self._daemon_boot_id,
            "t_ns": utc_ns,
            "t_uncertainty_ns": 0,
            "lost": self.lost(),
            "board_boot_id": self.board_boot_id,
        }

    def of_window(self, t_ns: int, t_uncertainty_ns: int, board_ticks: int) -> WindowFields:
        """Return what headers of messages about a window share: the UTC of its middle, the board's ticks at its end."""
        return {
            "name": self.name,
            "daemon_boot_id": self._daemon_boot_id,
            "t_ns": t_ns,
            "t_uncertainty_ns": t_uncertainty_ns,
            "lost": self.lost(),
            "board_ticks": board_ticks,
        }

    def next_seq(self, topic: Topic[Any]) -> int:
        """Return the next number `seq` of a topic."""
        path = topic.path
        seq = self._seq[path]
        self._seq[path] = seq + 1
        return seq

    def skip(self, *topics: Topic[Any]) -> None:
        """Skip one number `seq` of each topic, for a message that is not made."""
        for topic in topics:
            self._seq[topic.path] += 1
