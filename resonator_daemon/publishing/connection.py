"""One connection to a broker, and keeping one for ever: MQTT 5 where the broker speaks it, else 3.1.1."""

import asyncio
import contextlib
import logging
import random
import re
import socket
import threading
from collections.abc import Awaitable, Callable
from typing import Any, Final

import aiomqtt
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.commands import Incoming

KEEPALIVE_S: Final = 5
CONNECT_TIMEOUT_S: Final = 5.0
PUBLISH_TIMEOUT_S: Final = 5.0
FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 1.0
STABLE_S: Final = 5.0  # a connection that lasted longer was a good one: the next attempts may come fast again

_UNSPECIFIED: Final = 128  # what the library makes of a connection that ended without a word
_UNSUPPORTED_VERSION: Final = 132
_NO_DELAY: Final = (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else Nagle and delayed ACK add 40 ms now and then

log = logging.getLogger(__name__)
_library_log = logging.getLogger(f"{__name__}.aiomqtt")
_library_log.setLevel(logging.CRITICAL)  # it logs each failure where it happens; here it is once per change

OnPublished = Callable[[int, bool], None]
OnMessage = Callable[[Incoming], None]
OnDenied = Callable[[str], None]


class BrokerClient(aiomqtt.Client):
    """An aiomqtt client that writes at once and tells exactly what became of each message.

    `send` takes the place of `publish`: it neither waits nor queues, and the number of system calls per message is
    one instead of six. `on_published(qos, refused)` is called when a QoS 0 message is written to the socket in full,
    and when a QoS 1 message is acknowledged. `on_message` takes the place of `messages`, and
    `on_denied(reason)` is called when the broker refuses what was listened to.
    """

    def __init__(
        self,
        broker: Mqtt,
        version: aiomqtt.ProtocolVersion,
        *,
        identifier: str | None = None,
        will: aiomqtt.Will | None = None,
        on_published: OnPublished | None = None,
        on_message: OnMessage | None = None,
        on_denied: OnDenied | None = None,
    ) -> None:
        super().__init__(
            broker.host,
            broker.port,
            username=broker.username,
            password=broker.password,
            protocol=version,
            identifier=identifier,
            will=will,
            keepalive=KEEPALIVE_S,
            timeout=CONNECT_TIMEOUT_S,
            socket_options=(_NO_DELAY,),
            logger=_library_log,
        )
        self.in_flight: dict[int, tuple[int, float]] = {}  # by message id: QoS, and when it was sent
        self.unacknowledged = 0
        self.version = version
        self._tell_published = on_published
        self._tell_message = on_message
        self._tell_denied = on_denied
        self._thread = threading.get_ident()
        self._sending = False
        self._writer: socket.socket | None = None
        self._client.on_publish = self._published
        self._client.on_socket_register_write = self._want_write
        self._client.on_socket_unregister_write = self._written
        if on_message is not None:
            self._client.on_message = self._received
        if on_denied is not None:  # else `subscribe` waits for the broker's word itself
            self._client.on_subscribe = self._subscribed

    @property
    def lost(self) -> asyncio.Future[None]:
        """Done when the connection has ended."""
        return self._disconnected

    @property
    def connected(self) -> bool:
        return self._client.socket() is not None

    @property
    def writable(self) -> bool:
        """Whether a message would be written now, not queued."""
        return self.connected and not self._client.want_write()

    @property
    def overdue(self) -> bool:
        """Whether a message has been on its way for too long: a broker that is frozen, or gone without a word."""
        oldest = next(iter(self.in_flight.values()), None)
        return oldest is not None and self._loop.time() - oldest[1] > PUBLISH_TIMEOUT_S

    def send(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,
        correlation: bytes | None = None,
        response_topic: str | None = None,
    ) -> None:
        """Write a message; only while `writable`. The last two are left out where the broker does not speak MQTT 5."""
        properties = None
        if self.version is aiomqtt.ProtocolVersion.V5 and (correlation or response_topic):
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            if correlation is not None:
                properties.CorrelationData = correlation
            if response_topic is not None:
                properties.ResponseTopic = response_topic
        self._sending = True
        info = self._client.publish(topic, payload, qos, retain, properties)
        self._sending = False
        self.in_flight[info.mid] = (qos, self._loop.time())
        self.unacknowledged += qos
        self._flush()

    def listen(self, topic_filter: str) -> None:
        """Ask for messages, QoS 1, without waiting for the broker's word."""
        self._client.subscribe(topic_filter, 1)

    def abort(self) -> None:
        """End the connection without a farewell: the broker publishes the last will."""
        connection = self._client.socket()
        if isinstance(connection, socket.socket):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            self._client.disconnect()
            self._client.loop_write()  # fails, upon which the library closes the socket and its watchers
        if self.lost.done():
            self.lost.exception()  # else asyncio complains that nobody looked

    def _flush(self) -> None:
        self._client.loop_write()
        connection = self._client.socket()
        if isinstance(connection, socket.socket) and self._client.want_write() and self._writer is None:
            self._writer = connection
            self._loop.add_writer(connection, self._flush)

    def _want_write(self, *_: Any) -> None:
        if threading.get_ident() != self._thread:  # CONNECT is queued by the thread that connects
            self._loop.call_soon_threadsafe(self._flush)
        elif not self._sending and self._writer is None:
            self._loop.call_soon(self._flush)

    def _written(self, *_: Any) -> None:
        if self._writer is not None:
            self._loop.remove_writer(self._writer)
            self._writer = None

    def _published(self, _client: object, _userdata: object, mid: int, reason: Any, _properties: object) -> None:
        qos, _ = self.in_flight.pop(mid, (None, None))
        if qos is not None and self._tell_published is not None:
            self.unacknowledged -= qos
            self._tell_published(qos, reason.is_failure)

    def _subscribed(
        self, _client: object, _userdata: object, _mid: int, reasons: list[Any], _properties: object
    ) -> None:
        denied = [str(reason) for reason in reasons if reason.is_failure]
        if denied and self._tell_denied is not None:
            self._tell_denied(denied[0])

    def _received(self, _client: object, _userdata: object, message: Any) -> None:
        if self._tell_message is not None:
            asked = message.properties  # of MQTT 5, else None
            response_topic = getattr(asked, "ResponseTopic", None)
            correlation = getattr(asked, "CorrelationData", None)
            self._tell_message(Incoming(message.topic, message.payload, message.retain, response_topic, correlation))


async def keep_connected(
    broker: Mqtt,
    make_client: Callable[[aiomqtt.ProtocolVersion], BrokerClient],
    serve: Callable[[BrokerClient], Awaitable[None]],
    closing: asyncio.Future[None],
) -> None:
    """Connect, serve until the connection is lost, and again with a fresh client, until `closing` is done.

    `serve` is cancelled when the connection is over; it raises MqttError to give the connection up. Only with
    `closing` the client takes its leave; in every other case the broker publishes its last will.
    """
    loop = asyncio.get_running_loop()
    pause_s = FIRST_PAUSE_S
    version: aiomqtt.ProtocolVersion | None = None
    said = ""

    def say(level: int, text: str) -> None:
        nonlocal said
        if text != said:
            log.log(level, "broker %s:%d: %s", broker.host, broker.port, text)
        said = text

    while not closing.done():
        try:
            version = version or await _find_version(broker, closing)
            if version is None:
                return
            client = await _open(make_client(version), closing)
            if client is None:
                return
            connected_s = loop.time()
            say(logging.INFO, f"connected, MQTT {'5' if version is aiomqtt.ProtocolVersion.V5 else '3.1.1'}")
            try:
                await _serve_until_over(serve, client, closing)
                if closing.done() and client.writable:
                    await client.__aexit__(None, None, None)
            finally:
                client.abort()
                if loop.time() - connected_s > STABLE_S:
                    pause_s = FIRST_PAUSE_S
        except (aiomqtt.MqttError, OSError) as error:
            version = None  # another broker may answer next time
            said_by_broker = _code(error) != _UNSPECIFIED
            say(logging.WARNING, f"{error if said_by_broker else 'connection lost'}; trying again")
        await asyncio.wait([closing], timeout=pause_s * random.uniform(0.5, 1.0))
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)


async def _serve_until_over(
    serve: Callable[[BrokerClient], Awaitable[None]], client: BrokerClient, closing: asyncio.Future[None]
) -> None:
    serving = asyncio.ensure_future(serve(client))
    ends: list[asyncio.Future[Any]] = [serving, client.lost, closing]
    try:
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
    finally:
        serving.cancel()
        await asyncio.wait([serving])
    if not serving.cancelled():
        serving.result()
    if not closing.done():
        client.lost.result()
        raise aiomqtt.MqttError("connection lost")


def _code(error: Exception) -> int | None:
    reason = getattr(error, "rc", None)
    code: int | None = getattr(reason, "value", reason)
    return code


async def _find_version(broker: Mqtt, closing: asyncio.Future[None]) -> aiomqtt.ProtocolVersion | None:
    """Ask for MQTT 5 with the plainest connection there is; None when closing comes first.

    A broker that does not know version 5 may misread a will, a name or a password in a connection of that version,
    and wait for the rest of it for ever, instead of refusing (amqtt 0.12 does). Any answer but "unsupported version" is
    one of MQTT 5, "not authorised" too.
    """
    try:
        anonymous = broker.model_copy(update={"url": re.sub("//.*@", "//", broker.url)})
        probe = await _open(BrokerClient(anonymous, aiomqtt.ProtocolVersion.V5), closing)
    except aiomqtt.MqttCodeError as refusal:
        if _code(refusal) == _UNSUPPORTED_VERSION:
            return aiomqtt.ProtocolVersion.V311
    else:
        if probe is None:
            return None
        await probe.__aexit__(None, None, None)
    return aiomqtt.ProtocolVersion.V5


async def _open(client: BrokerClient, closing: asyncio.Future[None]) -> BrokerClient | None:
    """Connect; None when closing comes first.

    A thread does it that cannot be stopped halfway: an attempt that nobody waits for any more ends by itself.
    """

    def discard(attempt: asyncio.Future[Any]) -> None:
        if not attempt.cancelled():
            attempt.exception()
        client.abort()

    attempt = asyncio.ensure_future(client.__aenter__())
    either: list[asyncio.Future[Any]] = [attempt, closing]
    try:
        await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        if not attempt.done():
            return None
    finally:
        if not attempt.done():
            attempt.add_done_callback(discard)
    try:
        attempt.result()
        if not client.connected:
            raise aiomqtt.MqttError("the broker ended the connection at once")
    except UnicodeError as error:
        raise aiomqtt.MqttError(f"not a host name: {error}") from None
    except aiomqtt.MqttError:
        client.abort()
        raise
    return client
