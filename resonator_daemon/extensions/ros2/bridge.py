"""`resonatord bridge ros2`: publishes what plates publish as topics of ROS 2, without an installation of ROS.

Receives and encodes only the streams that somebody has subscribed to, each over a connection of its own. States and
health of all plates go to `/diagnostics` once a second, and at once when a state changes; what is no longer known is
marked as stale.
"""

import asyncio
import dataclasses
import time
from collections.abc import Iterable
from contextlib import aclosing, suppress
from typing import Any, Final

from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.extensions.ros2.messages import (
    DIAGNOSTICS,
    DIAGNOSTICS_TOPIC,
    STALE,
    Diagnostics,
    Translation,
    diagnostics_of,
    make_typestore,
)
from resonator_daemon.extensions.ros2.node import Ros2Node
from resonator_daemon.extensions.viewer_support import Geometry
from resonator_daemon.mqtt.payloads import Condition, Health, Info, Message, State
from resonator_daemon.mqtt.subscriber import EVERY_PLATE, subscribe
from resonator_daemon.mqtt.topics import (
    CONTACT_EVENT,
    CONTACTS,
    DECODED,
    DECODED_SUMMARY,
    FORCES,
    HEALTH,
    SIGNALS,
    STATE_DAEMON,
    TONES,
    TOPICS,
    Topic,
)

LOOK_S: Final = 0.2  # from subscription to the first message, at most
REPORT_S: Final = 1.0
SILENT_S: Final = 5.0  # a plate in operation publishes its health each second

_ALWAYS: Final = (CONTACTS.path, CONTACT_EVENT.path)
_STREAMS: Final = (CONTACTS, FORCES, SIGNALS, DECODED, DECODED_SUMMARY)


async def serve(
    broker: Mqtt,
    domain_id: int,
    *,
    plate: str | None = None,
    namespace: str = "",
    humble: bool = False,
    full_rate: bool = True,
) -> None:
    """Publish plates below the broker's prefix until SIGINT, SIGTERM or SIGHUP.

    Parameters
    ----------
    broker
        Where plates publish; it may come and go.
    domain_id
        As ROS_DOMAIN_ID.
    plate
        The only one; None: all of them.
    namespace
        Before the names of topics, and of the node: empty, or as `/hand`.
    humble
        Whether to announce the node as versions up to Humble read it.
    full_rate
        Whether to subscribe to all messages, or to the decimated topics.

    Raises
    ------
    UserError
        The domain cannot be joined.
    """
    serving = asyncio.create_task(_serve(broker, plate, full_rate, Ros2Bridge(domain_id, namespace, humble=humble)))
    with on_signals(serving.cancel), suppress(asyncio.CancelledError):
        await serving


class Ros2Bridge:
    """Plates as topics of one node of ROS, until `close`.

    Parameters
    ----------
    domain_id, namespace, humble
        As of `serve`.
    """

    def __init__(self, domain_id: int, namespace: str = "", *, humble: bool = False) -> None:
        self._namespace = namespace
        self._store = make_typestore(humble=humble)
        self._node = Ros2Node(domain_id, namespace, self._store)
        self._plates: dict[str, Translation] = {}
        self._topics: dict[str, set[str]] = {}  # of each plate
        self._statuses: dict[str, dict[str, Any]] = {}  # of each plate by path
        self._lost: dict[str, int] = {}
        self._arrived_s: dict[str, float] = {}
        self._offline: set[str] = set()
        self._node.advertise({DIAGNOSTICS_TOPIC: DIAGNOSTICS})

    def add(self, plate: str, path: str, message: Message) -> None:
        """Publish what a message becomes, if anybody has subscribed to it."""
        self._arrived_s[plate] = time.monotonic()
        if isinstance(message, Info):
            self._add_plate(plate, message)
        elif isinstance(message, State | Health):
            self._add_status(plate, path, message)
        elif (translation := self._plates.get(plate)) is not None:  # its info comes with the subscription
            for one in translation.messages(path, message):
                if self._node.has_readers(one.topic):
                    self._node.write(one.topic, translation.encode(one))

    def report(self) -> None:
        """Publish the last state and health of each plate."""
        if not self._node.has_readers(DIAGNOSTICS_TOPIC):
            return
        statuses = [status for plate in self._statuses for status in self._statuses_of(plate)]
        array = diagnostics_of(self._store, time.time_ns(), statuses)
        self._node.write(DIAGNOSTICS_TOPIC, bytes(self._store.serialize_cdr(array, DIAGNOSTICS)))

    def is_read(self, path: str) -> bool:
        """Return whether a topic made from this one, of any plate, has a subscriber."""
        topics = {topic for plate in self._plates.values() for topic in plate.topics([path])}
        return any(self._node.has_readers(topic) for topic in topics)

    def close(self) -> None:
        """Leave the domain."""
        self._node.close()

    def _add_plate(self, plate: str, info: Info) -> None:
        translation = Translation(plate, Geometry.of_info(info), self._namespace, self._store)
        topics = translation.topics({*_ALWAYS, *info.rates_hz})
        others = set().union(*(known for name, known in self._topics.items() if name != plate))
        gone = self._topics.get(plate, set()) - topics.keys() - others
        self._plates[plate], self._topics[plate] = translation, set(topics)
        if gone:
            self._node.withdraw(gone)
        self._node.advertise(topics)

    def _add_status(self, plate: str, path: str, message: State | Health) -> None:
        diagnostics, statuses = Diagnostics(plate, self._store), self._statuses.setdefault(plate, {})
        if isinstance(message, Health):
            lost = sum(message.lost.model_dump(exclude_none=True).values())
            statuses[path] = diagnostics.of_health(message, lost_more=lost > self._lost.get(plate, lost))
            self._lost[plate] = lost
            return
        statuses[path] = diagnostics.of_state(path, message)
        if path == STATE_DAEMON.path:
            offline = message.state is Condition.OFFLINE
            (self._offline.add if offline else self._offline.discard)(plate)
        self.report()

    def _statuses_of(self, plate: str) -> Iterable[Any]:
        known = sorted(self._statuses[plate].items())
        silent_s = time.monotonic() - self._arrived_s[plate]
        if plate in self._offline:
            text = "the daemon is offline"
        elif silent_s > SILENT_S and HEALTH.path in self._statuses[plate]:
            text = f"no message for {silent_s:.0f} s: the broker or the network is gone"
        else:
            return [status for _, status in known]
        return [
            status
            if plate in self._offline and path == STATE_DAEMON.path
            else dataclasses.replace(status, level=STALE, message=f"{text}; last: {status.message}")
            for path, status in known
        ]


async def _serve(broker: Mqtt, plate: str | None, full_rate: bool, bridge: Ros2Bridge) -> None:
    async def follow(*topics: Topic[Any]) -> None:
        async with aclosing(subscribe(broker, topics, plate=plate or EVERY_PLATE, full_rate=full_rate)) as received:
            async for name, path, message in received:
                bridge.add(name, path, message)

    following: dict[Topic[Any], asyncio.Task[None]] = {}
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(follow(*(topic for topic in TOPICS.values() if topic not in (*_STREAMS, TONES))))
            tasks.create_task(_report(bridge))
            while True:
                wanted = [topic for topic in _STREAMS if bridge.is_read(topic.path)]
                for topic in following.keys() - wanted:
                    following.pop(topic).cancel()
                for topic in wanted:
                    if topic not in following:
                        following[topic] = tasks.create_task(follow(topic))
                await asyncio.sleep(LOOK_S)
    finally:
        bridge.close()


async def _report(bridge: Ros2Bridge) -> None:
    while True:
        await asyncio.sleep(REPORT_S)
        bridge.report()
