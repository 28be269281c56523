"""The last messages of one plate, as one subscriber received them."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from resonator_daemon.mqtt.payloads import ContactEvent, Contacts, Header, Lost, Message
from resonator_daemon.mqtt.topics import HEALTH, INFO, TOPICS, MessageT, Topic

_RATE_NS: Final = 1_000_000_000
_HEALTH_PERIOD_S: Final = 1.0
HISTORY_NS: Final = 30 * _RATE_NS
_LOSS_RATE_OVER: Final = 10  # reports of health


@dataclass
class _Run:
    """What came from one run of the daemon, by path."""

    newest_t_ns: int = 0
    lost: Lost = field(default_factory=Lost)
    arrived_utc_ns: int | None = None
    last: dict[str, tuple[Header, int]] = field(default_factory=dict)  # message, and when it arrived
    arrivals: dict[str, deque[tuple[int, int]]] = field(default_factory=dict)  # within the last second: when, and seq
    since_t_ns: dict[int | None, int] = field(default_factory=dict)  # of the present contacts, by id
    pressed: deque[tuple[int, float]] = field(default_factory=deque)  # arrival, and largest normal force in newton
    losses: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_LOSS_RATE_OVER))  # arrival, and sum

    def add(self, path: str, message: Header, arrived_utc_ns: int) -> None:
        self.newest_t_ns = max(self.newest_t_ns, message.t_ns)
        # Losses only grow; a last will has old ones.
        self.lost = max(self.lost, message.lost, key=lambda lost: sum(lost.model_dump().values()))
        self.arrived_utc_ns = arrived_utc_ns
        if path == HEALTH.path:
            self.losses.append((arrived_utc_ns, sum(self.lost.model_dump().values())))
        self.last[path] = (message, arrived_utc_ns)
        if isinstance(message, Contacts):
            self.since_t_ns = {
                contact.id: self.since_t_ns.get(contact.id, message.t_ns) for contact in message.contacts
            }
            normal = [contact.force_newton[2] for contact in message.contacts]
            self.pressed.append((arrived_utc_ns, max(filter(math.isfinite, normal), default=0.0)))
            while not arrived_utc_ns - HISTORY_NS < self.pressed[0][0] <= arrived_utc_ns:
                self.pressed.popleft()
        elif isinstance(message, ContactEvent):
            self.since_t_ns[message.contact.id] = message.contact.since_t_ns
        arrivals = self.arrivals.setdefault(path, deque())
        arrivals.append((arrived_utc_ns, message.seq))
        # A clock that was set back leaves arrivals in the future, which must not pile up.
        while not arrived_utc_ns - _RATE_NS < arrivals[0][0] <= arrived_utc_ns:
            arrivals.popleft()


class PlateView:
    """The last message on each topic of a plate, message rates, and the losses that its daemon reports.

    Decimated topics stand for the streams that they are of.

    A new run of the daemon (`daemon_boot_id`) starts with nothing. Retained messages come in any order and may be of
    an earlier run: they begin a new run only when they are newer than all of the present one.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._run = _Run()
        self._runs: dict[str, _Run] = {}

    @property
    def lost(self) -> Lost | None:
        """Losses that the daemon last reported; None before its first message."""
        return self._run.lost if self._run.last else None

    @property
    def loss_rate_hz(self) -> float:
        """Losses a second in the last seconds; 0 while that is not known."""
        losses = self._run.losses
        if len(losses) < 2:
            return 0.0
        (first_utc_ns, first), (last_utc_ns, last) = losses[0], losses[-1]
        return (last - first) / max(last_utc_ns - first_utc_ns, 1) * 1e9

    @property
    def pressed(self) -> Sequence[tuple[int, float]]:
        """Arrivals of `contacts` in the last `HISTORY_NS`, and the largest normal force in newton, 0 without one."""
        return self._run.pressed

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
        """Messages that the plate makes a second, over the last second; NaN if fewer than two have come in it."""
        arrivals = self._run.arrivals.get(topic.path, ())
        recent = [arrival for arrival in arrivals if now_utc_ns - _RATE_NS < arrival[0] <= now_utc_ns]
        if len(recent) < 2:
            return math.nan
        (first_utc_ns, first), (last_utc_ns, last) = recent[0], recent[-1]
        return (last - first) / max(last_utc_ns - first_utc_ns, 1) * 1e9

    def age_s(self, now_utc_ns: int) -> float:
        """Seconds since the last message of any kind; NaN before the first."""
        return math.nan if self._run.arrived_utc_ns is None else (now_utc_ns - self._run.arrived_utc_ns) / 1e9
