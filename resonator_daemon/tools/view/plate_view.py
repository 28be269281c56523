"""The last messages of one plate, as one subscriber received them, and the emulator's truth."""

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.mqtt.payloads import ContactEvent, Contacts, Header, Lost, Message
from resonator_daemon.mqtt.topics import HEALTH, INFO, TOPICS, MessageT, Topic

_RATE_NS: Final = 1_000_000_000
_HEALTH_PERIOD_S: Final = 1.0


@dataclass(frozen=True)
class TrueContact:
    """One touch as it truly is."""

    site: int | None  # where the touch is exactly on a site
    position_m: tuple[float, float]
    force_newton: tuple[float, float, float]


@dataclass(frozen=True)
class Truth:
    """Truth of an emulated plate, shown next to the measurement."""

    contacts: tuple[TrueContact, ...]
    traction_z_pascal: NDArray[np.float64] | None  # (ny, nx), or at the sites (n,); positive where pressed
    latency_ms: tuple[float, float] | None  # from touch to subscriber: median and 99 %
    losses: Mapping[str, int] = field(default_factory=dict)  # by cause, since the measurement began


@dataclass
class _Run:
    """What came from one run of the daemon, by path."""

    newest_t_ns: int = 0
    lost: Lost = field(default_factory=Lost)
    arrived_utc_ns: int | None = None
    last: dict[str, tuple[Header, int]] = field(default_factory=dict)  # message, and when it arrived
    first_arrived_utc_ns: dict[str, int] = field(default_factory=dict)
    arrivals: dict[str, deque[tuple[int, int]]] = field(default_factory=dict)  # within the last second: when, and seq
    missed: Counter[str] = field(default_factory=Counter)
    since_t_ns: dict[int | None, int] = field(default_factory=dict)  # of the present contacts, by id

    def add(self, path: str, message: Header, arrived_utc_ns: int) -> None:
        if path in self.last:
            self.missed[path] += max(0, message.seq - self.last[path][0].seq - 1)
        self.newest_t_ns = max(self.newest_t_ns, message.t_ns)
        self.lost = max(
            self.lost, message.lost, key=lambda lost: sum(lost.model_dump().values())
        )  # they only grow; a last will has old ones
        self.arrived_utc_ns = arrived_utc_ns
        self.last[path] = (message, arrived_utc_ns)
        self.first_arrived_utc_ns.setdefault(path, arrived_utc_ns)
        if isinstance(message, Contacts):
            self.since_t_ns = {
                contact.id: self.since_t_ns.get(contact.id, message.t_ns) for contact in message.contacts
            }
        elif isinstance(message, ContactEvent):
            self.since_t_ns[message.contact.id] = message.contact.since_t_ns
        arrivals = self.arrivals.setdefault(path, deque())
        arrivals.append((arrived_utc_ns, message.seq))
        # A clock that was set back leaves arrivals in the future, which must not pile up.
        while not arrived_utc_ns - _RATE_NS < arrivals[0][0] <= arrived_utc_ns:
            arrivals.popleft()


class PlateView:
    """The last message on each topic of a plate, message rates, and messages that this subscriber missed.

    Without `full_rate` it is given the decimated topics of those topics that have one.

    A new run of the daemon (`daemon_boot_id`) starts with nothing. Retained messages come in any order and may be of
    an earlier run: they begin a new run only when they are newer than all of the present one.
    """

    def __init__(self, name: str, *, full_rate: bool = True) -> None:
        self.name = name
        self._decimated = () if full_rate else tuple(path for path, topic in TOPICS.items() if topic.slow_hz)
        self._run = _Run()
        self._runs: dict[str, _Run] = {}

    @property
    def missed(self) -> Mapping[str, int]:
        """Messages that did not arrive, by path: gaps in `seq` since the first; unknown for decimated topics."""
        return Counter({path: count for path, count in self._run.missed.items() if path not in self._decimated})

    @property
    def lost(self) -> Lost | None:
        """Losses that the daemon last reported; None before its first message."""
        return self._run.lost if self._run.last else None

    def add(self, path: str, message: Message, arrived_utc_ns: int) -> None:
        """Add a message on the topic with this path below the plate."""
        if not isinstance(message, Header):
            raise ValueError(f"{path}: got {type(message).__name__}, must be a message with a header")
        run = self._runs.setdefault(message.daemon_boot_id, _Run())
        if not TOPICS[path].retained:
            self._run = run
            self._runs = {message.daemon_boot_id: run}
        elif message.t_ns >= self._run.newest_t_ns:
            self._run = run
        run.add(path, message, arrived_utc_ns)

    def last(self, topic: Topic[MessageT]) -> MessageT | None:
        """Return the last message on a topic, however old; None before the first."""
        message, _ = self._run.last.get(topic.path, (None, 0))
        return message if isinstance(message, topic.payload) else None

    def current(self, topic: Topic[MessageT], now_utc_ns: int) -> MessageT | None:
        """Return the last message on a topic while it is recent: for a second or three periods."""
        info = self.last(INFO)
        period_s = _HEALTH_PERIOD_S if topic.path == HEALTH.path else info.step_s if info else 0.0
        _, arrived_utc_ns = self._run.last.get(topic.path, (None, 0))
        return self.last(topic) if now_utc_ns - arrived_utc_ns <= max(1.0, 3 * period_s) * 1e9 else None

    def contact_since_t_ns(self, contact_id: int | None, default: int) -> int:
        """Return the onset of a present contact, or the first message with it if its onset was not received."""
        return self._run.since_t_ns.get(contact_id, default)

    def rate_hz(self, topic: Topic[Any], now_utc_ns: int) -> float:
        """Messages that the plate makes a second, over the last second; NaN in the first one."""
        begun_utc_ns = now_utc_ns - _RATE_NS
        if self._run.first_arrived_utc_ns.get(topic.path, now_utc_ns) > begun_utc_ns:
            return math.nan
        recent = [arrival for arrival in self._run.arrivals[topic.path] if begun_utc_ns < arrival[0] <= now_utc_ns]
        if topic.path in self._decimated and len(recent) > 1:
            (first_utc_ns, first), (last_utc_ns, last) = recent[0], recent[-1]
            return (last - first) / max(last_utc_ns - first_utc_ns, 1) * 1e9
        return float(len(recent))

    def age_s(self, now_utc_ns: int) -> float:
        """Seconds since the last message of any kind; NaN before the first."""
        return math.nan if self._run.arrived_utc_ns is None else (now_utc_ns - self._run.arrived_utc_ns) / 1e9
