"""Publishes messages without ever waiting for the broker, and accounts for each of them."""

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Callable
from typing import Final, TypeVar

import aiomqtt

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.commands import Commands, Handler, Outgoing
from resonator_daemon.publishing.connection import BrokerClient, keep_connected
from resonator_daemon.publishing.payloads import MessageAccount, State
from resonator_daemon.publishing.topics import STATE_DAEMON, MessageT, Topic, full_topic

STREAMS_WAITING_MAX: Final = 256  # about half a second of everything, 10 MB of the largest arrays
EVENTS_WAITING_MAX: Final = 1024
ANSWERS_WAITING_MAX: Final = 32
UNACKNOWLEDGED_MAX: Final = 10  # below every broker's usual limit of 20
CLOSE_TIMEOUT_S: Final = 2.0

_WATCH_S: Final = 1.0

log = logging.getLogger(__name__)

QueuedT = TypeVar("QueuedT")


class Publisher:
    """Sends messages to one broker, whether it is there or not; to be used from the event loop's thread only.

    Streams (QoS 0) are dropped while there is no connection, and the oldest first when the broker does not keep up.
    Events (QoS 1) wait for a connection, the newest 1024 of them. Of a retained topic the last message is kept, and
    sent again with each new connection. Each message is in exactly one term of `account`.

    Parameters
    ----------
    broker
        Address, credentials and prefix of the topics.
    name
        Second level of the topics, and part of the client's identifier: a daemon that comes back takes over its old
        connection, whose last will would otherwise come after the new birth message.
    make_offline
        Makes the state "offline" of the daemon for a reason: the last will, and the farewell of `close`.
    handler
        Takes the commands of `cmd/<verb>`, and answers them; without one nothing is subscribed to.
    """

    def __init__(
        self, broker: Mqtt, name: str, make_offline: Callable[[str], State], handler: Handler | None = None
    ) -> None:
        self._broker = broker
        self._name = name
        self._make_offline = make_offline
        self._client: BrokerClient | None = None
        self._retained: dict[str, bytes] = {}  # last message by topic
        self._states: dict[str, bytes] = {}  # those of them that wait
        self._commands = Commands(f"{broker.prefix}/{name}", handler, self._answer) if handler else None
        self._events: deque[tuple[str, bytes]] = deque()
        self._answers: deque[Outgoing] = deque()
        self._streams: deque[tuple[str, bytes]] = deque()
        self._pumping = False
        self._denied = False
        self._closed = False
        self._idle = asyncio.Event()
        self._closing: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._ended = asyncio.Event()
        self._ended.set()
        self._made = self._restored = self._acknowledged = self._handed_to_socket = 0
        self._dropped = self._superseded = self._unknown_at_disconnect = 0

    @property
    def connected(self) -> bool:
        return self._client is not None

    @property
    def dropped(self) -> int:
        """Messages that a subscriber misses; `lost.publish_dropped` of the messages to come.

        A state that gave way to a newer one before it was sent counts in `account.dropped` only: nobody misses it.
        """
        return self._dropped - self._superseded

    @property
    def account(self) -> MessageAccount:
        return MessageAccount(
            made=self._made,
            restored=self._restored,
            acknowledged=self._acknowledged,
            handed_to_socket=self._handed_to_socket,
            dropped=self._dropped,
            unknown_at_disconnect=self._unknown_at_disconnect,
            waiting=self._waiting,
        )

    @property
    def _waiting(self) -> int:
        in_flight = len(self._client.in_flight) if self._client else 0
        return len(self._states) + len(self._events) + len(self._answers) + len(self._streams) + in_flight

    def publish(self, topic: Topic[MessageT], message: MessageT) -> None:
        """Send a message as soon as may be, or drop it by the rules of its topic; returns at once."""
        if not isinstance(message, topic.payload):
            raise ValueError(f"{topic.path} carries {topic.payload.__name__}, not {type(message).__name__}")
        self._made += 1
        if self._closed or (topic.qos == 0 and self._client is None):
            self._dropped += 1
            return
        name = full_topic(self._broker.prefix, self._name, topic.path)
        payload = encode(message)
        if topic.retained:
            if name in self._states:
                self._dropped += 1
                self._superseded += 1
            self._retained[name] = self._states[name] = payload
        elif topic.qos:
            self._queue(self._events, EVENTS_WAITING_MAX, (name, payload))
        else:
            self._queue(self._streams, STREAMS_WAITING_MAX, (name, payload))
        self._idle.clear()
        self._pump_soon()

    async def run(self) -> None:
        """Keep connected until `close`; when cancelled instead, the broker publishes the last will."""
        self._ended.clear()
        try:
            await keep_connected(self._broker, self._make_client, self._serve, self._closing)
        finally:
            self._closed = True
            self._dropped += len(self._states) + len(self._events)
            self._states.clear()
            self._events.clear()
            self._drop_answers()
            self._ended.set()

    async def close(self, *, wait_for_broker: bool = False) -> None:
        """Say that the daemon stopped, wait up to 2 s for what is still to be sent, and end `run`.

        `wait_for_broker`: also where there is no connection yet, because why the daemon ends is worth the time.
        """
        self.publish(STATE_DAEMON, self._make_offline("stopped"))
        self._closed = True
        if self._client is not None or wait_for_broker:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_TIMEOUT_S):
                    await self._idle.wait()
        if not self._closing.done():
            self._closing.set_result(None)
        await self._ended.wait()

    def _make_client(self, version: aiomqtt.ProtocolVersion) -> BrokerClient:
        will = self._make_offline("connection lost").model_copy(update={"since_t_ns": None})
        return BrokerClient(
            self._broker,
            version,
            identifier=f"resonatord-{self._broker.prefix}-{self._name}",
            will=aiomqtt.Will(
                full_topic(self._broker.prefix, self._name, STATE_DAEMON.path),
                encode(will),
                qos=STATE_DAEMON.qos,
                retain=STATE_DAEMON.retained,
            ),
            on_published=self._on_published,
            on_message=self._commands.take if self._commands else None,
            on_denied=self._on_denied,
        )

    async def _serve(self, client: BrokerClient) -> None:
        again = {topic: payload for topic, payload in self._retained.items() if topic not in self._states}
        self._states.update(again)
        self._made += len(again)
        self._restored += len(again)
        self._client = client
        if self._commands is not None:
            client.listen(self._commands.topic_filter)
        self._pump_soon()
        try:
            while not client.overdue:  # noqa: ASYNC110  it is the passing of time that is watched
                await asyncio.sleep(_WATCH_S)
            raise aiomqtt.MqttError("no answer")
        finally:
            self._client = None
            self._unknown_at_disconnect += len(client.in_flight)
            client.in_flight.clear()
            self._dropped += len(self._streams)
            self._streams.clear()
            self._drop_answers()

    def _on_denied(self, reason: str) -> None:
        """Say once that commands are not heard; with each new connection it would be said again."""
        if self._commands is not None and not self._denied:
            self._denied = True
            log.warning("broker denies %s (%s): commands are not heard", self._commands.topic_filter, reason)

    def _answer(self, answer: Outgoing) -> None:
        """Send an answer to a command, after all events: a flood of commands costs nobody an event."""
        self._made += 1
        if self._closed or self._client is None:
            self._dropped += 1
            return
        self._queue(self._answers, ANSWERS_WAITING_MAX, answer)
        self._idle.clear()
        self._pump_soon()

    def _drop_answers(self) -> None:
        """Forget answers of a connection that is over: whoever asked may be gone, too."""
        self._dropped += len(self._answers)
        self._answers.clear()

    def _queue(self, queue: deque[QueuedT], limit: int, message: QueuedT) -> None:
        if len(queue) >= limit:
            queue.popleft()
            self._dropped += 1
        queue.append(message)

    def _pump_soon(self) -> None:
        if not self._pumping and self._client is not None:
            self._pumping = True
            asyncio.get_running_loop().call_soon(self._pump)

    def _pump(self) -> None:
        """Send while the socket takes it; acknowledged messages first, as they are few, but only some at a time."""
        client = self._client
        while client is not None and client.writable:
            room = client.unacknowledged < UNACKNOWLEDGED_MAX
            if room and self._states:
                topic = next(iter(self._states))
                client.send(topic, self._states.pop(topic), qos=1, retain=True)
            elif room and self._events:
                client.send(*self._events.popleft(), qos=1)
            elif room and self._answers:
                answer = self._answers.popleft()
                client.send(answer.topic, answer.payload, qos=1, correlation=answer.correlation)
            elif self._streams:
                client.send(*self._streams.popleft(), qos=0)
            else:
                break
        self._pumping = False

    def _on_published(self, qos: int, refused: bool) -> None:
        if refused:
            self._dropped += 1
        elif qos:
            self._acknowledged += 1
        else:
            self._handed_to_socket += 1
        if self._states or self._events or self._answers or self._streams:
            self._pump_soon()
        elif not self._waiting:
            self._idle.set()
