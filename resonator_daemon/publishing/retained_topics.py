"""Restoration of retained topics that another client has overwritten or cleared, at a bounded rate."""

import asyncio
import logging
from collections import defaultdict, deque
from collections.abc import Callable, Collection
from functools import partial
from typing import Final

from resonator_daemon.publishing.mqtt_messages import Incoming

RESTORE_EVERY_S: Final = 1.0
LOG_EVERY_S: Final = 60.0

_OWN_MAX: Final = 8  # messages of a topic that may still come back from the broker

log = logging.getLogger(__name__)


class RetainedTopics:
    """Restores retained topics, all that are overwritten together and at most once a second.

    To be used from the event loop's thread only.

    Parameters
    ----------
    republish
        Called with the topics whose last message is to be sent again.
    conflict
        Returns whether another daemon publishes under the same name; then nothing is restored, as both would do so.
    """

    def __init__(self, republish: Callable[[Collection[str]], None], conflict: Callable[[], bool]) -> None:
        self._republish = republish
        self._conflict = conflict
        self._loop = asyncio.get_running_loop()
        self._own: defaultdict[str, deque[bytes]] = defaultdict(partial(deque, maxlen=_OWN_MAX))
        self._overwritten: set[str] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._next_s = self._next_log_s = self._loop.time()

    def published(self, topic: str, payload: bytes) -> None:
        """Set the last message of a topic; it comes back from a broker to which the topic is subscribed."""
        self._own[topic].append(payload)

    def receive(self, message: Incoming) -> None:
        """Handle a message of any sender; those that the broker had retained are older than ours."""
        if message.retained or message.topic not in self._own or message.payload in self._own[message.topic]:
            return
        self._overwritten.add(message.topic)
        if self._timer is None:
            self._timer = self._loop.call_at(max(self._next_s, self._loop.time()), self._restore)

    def close(self) -> None:
        """Restore nothing any more."""
        if self._timer is not None:
            self._timer.cancel()

    def _restore(self) -> None:
        topics, self._overwritten, self._timer = self._overwritten, set(), None
        if self._conflict():
            return
        now_s = self._loop.time()
        self._next_s = now_s + RESTORE_EVERY_S
        if now_s >= self._next_log_s:
            self._next_log_s = now_s + LOG_EVERY_S
            log.warning(
                "another client overwrites or clears retained topics, which are restored: %s", ", ".join(sorted(topics))
            )
        self._republish(topics)
