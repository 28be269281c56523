"""Restoration of retained topics that another client overwrites or clears, with growing pauses for each topic."""

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from resonator_daemon.mqtt.codec import Incoming

PAUSES_S: Final = (0.0, 5.0, 30.0, 60.0)  # before the first, second, ... restoration of a topic; the last pause repeats
QUIET_S: Final = 120.0  # without a restoration, after which the pauses begin again

_OWN_MAX: Final = 8  # messages of a topic that the broker may still return

log = logging.getLogger(__name__)


@dataclass
class _Topic:
    own: deque[bytes] = field(default_factory=lambda: deque(maxlen=_OWN_MAX))
    restorations: int = 0
    restored_s: float = -math.inf
    due: asyncio.TimerHandle | None = None  # of the next restoration


class RetainedTopics:
    """Schedules the restoration of overwritten topics; to be used from the event loop's thread only.

    A message is foreign if it is none of this publisher's last messages. This includes a last will that the broker
    publishes after a reconnection. A foreign message affects its own topic only.

    Parameters
    ----------
    restore
        Called with the topic whose last message is to be sent again.
    """

    def __init__(self, restore: Callable[[str], None]) -> None:
        self._restore = restore
        self._loop = asyncio.get_running_loop()
        self._topics: dict[str, _Topic] = {}

    def published(self, name: str, payload: bytes) -> None:
        """Store the last message of a topic; it replaces a foreign message, so that no restoration is due."""
        topic = self._topics.setdefault(name, _Topic())
        topic.own.append(payload)
        if topic.due is not None:
            topic.due.cancel()
            topic.due = None

    def receive(self, message: Incoming) -> None:
        """Handle a message of any sender; retained ones are ignored, since they are older than this publisher's."""
        topic = self._topics.get(message.topic)
        if topic is None or topic.due is not None or message.retained or message.payload in topic.own:
            return
        now_s = self._loop.time()
        if now_s - topic.restored_s >= QUIET_S:
            topic.restorations = 0
        due_s = topic.restored_s + PAUSES_S[min(topic.restorations, len(PAUSES_S) - 1)]
        topic.due = self._loop.call_at(max(now_s, due_s), self._restore_topic, message.topic)

    def restore_now(self) -> None:
        """Restore overwritten topics without the rest of their pauses; all pauses begin again."""
        for name, topic in self._topics.items():
            topic.restorations = 0
            if topic.due is not None:
                topic.due.cancel()
                self._restore_topic(name)

    def close(self) -> None:
        """Cancel all restorations."""
        for topic in self._topics.values():
            if topic.due is not None:
                topic.due.cancel()
        self._topics.clear()

    def _restore_topic(self, name: str) -> None:
        topic = self._topics[name]
        topic.due = None
        topic.restored_s = self._loop.time()
        topic.restorations += 1
        if topic.restorations == 1:
            log.info("%s was overwritten, by another client or a late last will: it is restored", name)
        self._restore(name)
