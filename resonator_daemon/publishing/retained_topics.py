"""Retained topics that another client has overwritten, cleared or added are put right, at a bounded rate."""

import asyncio
import logging
import math
from collections import defaultdict, deque
from collections.abc import Callable, Collection
from functools import partial
from typing import Final

from paho.mqtt.client import topic_matches_sub

from resonator_daemon.publishing.mqtt_messages import Incoming

RESTORE_EVERY_S: Final = 1.0
FIRST_LOG_S: Final = 1.5  # after the first repair, so that those of the next second are in the same line
LOG_EVERY_S: Final = 60.0

_OWN_MAX: Final = 8  # messages of a topic that may still come back from the broker

log = logging.getLogger(__name__)


class RetainedTopics:
    """Restores retained topics that another overwrites, and clears topics of streams that another retains.

    All that are affected together, and at most once a second. To be used from the event loop's thread only.

    Parameters
    ----------
    republish
        Called with the topics whose last message is to be sent again.
    clear
        Called with the topics whose retained message is to be removed.
    conflict
        Returns whether another daemon publishes under the same name; then nothing is done, as both would do so.
    never_retained
        Filters of topics without a retained message.
    """

    def __init__(
        self,
        republish: Callable[[Collection[str]], None],
        clear: Callable[[Collection[str]], None],
        conflict: Callable[[], bool],
        never_retained: Collection[str],
    ) -> None:
        self._republish = republish
        self._clear = clear
        self._conflict = conflict
        self._never_retained = never_retained
        self._loop = asyncio.get_running_loop()
        self._own: defaultdict[str, deque[bytes]] = defaultdict(partial(deque, maxlen=_OWN_MAX))
        self._wills: deque[bytes] = deque(maxlen=_OWN_MAX)
        self._affected: dict[str, bool] = {}  # whether another client was the cause
        self._unlogged: set[str] = set()
        self._timer: asyncio.TimerHandle | None = None
        self._log_timer: asyncio.TimerHandle | None = None
        self._next_s = self._loop.time()
        self._next_log_s = -math.inf

    def published(self, topic: str, payload: bytes) -> None:
        """Set the last message of a topic; it comes back from a broker to which the topic is subscribed."""
        self._own[topic].append(payload)

    def connected(self, will: bytes) -> None:
        """Set the last will of a connection; a broker that ends publishes it to that connection, too."""
        self._wills.append(will)

    def receive(self, message: Incoming) -> None:
        """Handle a message of any sender; on a retained topic, one that the broker had retained is older than ours."""
        if self._is_never_retained(message.topic):
            if not (message.retained and message.payload):
                return
        elif message.retained or message.topic not in self._own or message.payload in self._own[message.topic]:
            return
        is_other = message.payload not in self._wills
        self._affected[message.topic] = is_other or self._affected.get(message.topic, False)
        if self._timer is None:
            self._timer = self._loop.call_at(max(self._next_s, self._loop.time()), self._repair)

    def close(self) -> None:
        """Repair nothing any more."""
        if self._timer is not None:
            self._timer.cancel()
        if self._log_timer is not None:
            self._log_timer.cancel()
            self._log()

    def _repair(self) -> None:
        affected, self._affected, self._timer = self._affected, {}, None
        if self._conflict():
            return
        now_s = self._loop.time()
        self._next_s = now_s + RESTORE_EVERY_S
        topics = set(affected)
        self._unlogged.update(topic for topic, is_other in affected.items() if is_other)
        if self._log_timer is None and self._unlogged:
            self._log_timer = self._loop.call_at(max(self._next_log_s, now_s + FIRST_LOG_S), self._log)
        cleared = set(filter(self._is_never_retained, topics))
        self._republish(topics - cleared)
        self._clear(cleared)

    def _is_never_retained(self, topic: str) -> bool:
        return topic not in self._own and any(
            topic_matches_sub(topic_filter, topic) for topic_filter in self._never_retained
        )

    def _log(self) -> None:
        """Name all topics that were repaired since the last line."""
        topics, self._unlogged, self._log_timer = self._unlogged, set(), None
        self._next_log_s = self._loop.time() + LOG_EVERY_S
        cleared = set(filter(self._is_never_retained, topics))
        for done, which in (
            ("overwrites or clears retained topics, which are restored", topics - cleared),
            ("retains messages on topics of streams, which are cleared", cleared),
        ):
            if which:
                log.warning("another client %s: %s", done, ", ".join(sorted(which)))
