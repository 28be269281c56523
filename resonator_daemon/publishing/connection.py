"""One connection to a broker, and keeping one for ever: MQTT 5 where the broker speaks it, else 3.1.1."""

import asyncio
import contextlib
import logging
import socket
import ssl
import threading
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Final, NamedTuple, TypeVar

import aiomqtt
from paho.mqtt.client import PUBLISH, MQTTMessageInfo

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing import refusals
from resonator_daemon.publishing.backoff import Backoff
from resonator_daemon.publishing.broker_limits import BrokerLimits, limits_of
from resonator_daemon.publishing.mqtt_messages import Incoming
from resonator_daemon.publishing.packed_properties import PackedProperties, pack
from resonator_daemon.publishing.tls import make_tls

KEEPALIVE_S: Final = 5
CONNECT_TIMEOUT_S: Final = 5.0
PUBLISH_TIMEOUT_S: Final = 5.0  # without anything that moves
ACKNOWLEDGE_TIMEOUT_S: Final = 20.0  # of one message, while others move
FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 0.6  # a broker that is back has all states within a second
REFUSED_PAUSE_S: Final = 30.0  # longest one, of who is refused: brokers log and ban those who ask too often
STABLE_S: Final = 5.0  # a connection that lasted longer was a good one: the next attempts may come fast again

_UNSPECIFIED: Final = 128  # what the library makes of a connection that ended without a word
_NO_DELAY: Final = (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else Nagle and delayed ACK add 40 ms now and then
# Else the system takes megabytes that a slow broker has not asked for, and what matters waits behind them.
_UNSENT_BYTES_MAX: Final = (socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, 128 * 1024)

log = logging.getLogger(__name__)
_library_log = logging.getLogger(f"{__name__}.aiomqtt")
_library_log.setLevel(logging.CRITICAL)  # it logs each failure where it happens; here it is once per change

_Result = TypeVar("_Result")
OnPublished = Callable[["InFlight", bool], None]
OnMessage = Callable[[Incoming], None]
OnDenied = Callable[[str, str], None]


class InFlight(NamedTuple):
    """A message on its way."""

    qos: int
    since_s: float
    token: object  # the sender's
    messages: int = 1


class BrokerClient(aiomqtt.Client):
    """An aiomqtt client that writes at once and tells exactly what became of each message.

    `send` and `send_streams` take the place of `publish`: they neither wait nor queue. `on_published(sent, refused)`
    is called when QoS 0 messages are written to the socket in full, and when a QoS 1 message is acknowledged.
    `on_message` takes the place of `messages`, and
    `on_denied(topic_filter, reason)` is called when the broker refuses what was listened to.

    Attributes
    ----------
    limits
        What the broker said it takes, once connected.
    at_once
        The first attempt to connect since the last connection ended.
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
            protocol=version,
            identifier=identifier,
            will=will,
            keepalive=KEEPALIVE_S,
            timeout=CONNECT_TIMEOUT_S,
            socket_options=(_NO_DELAY, _UNSENT_BYTES_MAX),
            logger=_library_log,
        )
        self._broker = broker
        self._client.connect_timeout = CONNECT_TIMEOUT_S
        self.in_flight: dict[int, InFlight] = {}  # by message id
        self.unacknowledged = 0
        self.version = version
        self.limits = BrokerLimits()
        self.at_once = False
        self._progress_s = 0.0
        self._listened: dict[int, str] = {}  # filters by message id
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
    def messages_in_flight(self) -> int:
        return sum(sent.messages for sent in self.in_flight.values())

    @property
    def overdue(self) -> bool:
        """Whether nothing has moved for too long: a broker that is frozen, or gone without a word."""
        oldest = next(iter(self.in_flight.values()), None)
        if oldest is None:
            return False
        now_s = self._loop.time()
        return now_s - self._progress_s > PUBLISH_TIMEOUT_S or now_s - oldest.since_s > ACKNOWLEDGE_TIMEOUT_S

    def send(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: int,
        retain: bool = False,
        correlation: bytes | None = None,
        response_topic: str | None = None,
        properties: PackedProperties | None = None,
        token: object = None,
    ) -> None:
        """Write a message; only while `writable`.

        Properties are left out where the broker does not speak MQTT 5; those given packed go before the two others.
        """
        if self.version is not aiomqtt.ProtocolVersion.V5:
            properties = None
        elif properties is None and (correlation is not None or response_topic is not None):
            properties = pack(correlation=correlation, response_topic=response_topic)
        self._sending = True
        try:
            info = self._client.publish(topic, payload, qos, retain, properties)
        finally:
            self._sending = False
        now_s = self._loop.time()
        if not self.in_flight:
            self._progress_s = now_s
        self.in_flight[info.mid] = InFlight(qos, now_s, token)
        self.unacknowledged += qos
        self._flush()

    def send_streams(self, packets: Sequence[bytes]) -> int:
        """Write whole PUBLISH packets of QoS 0 with one system call, only while `writable`; return how many are begun.

        Of what is begun and not written in full, the rest is queued; what is not begun stays with the caller.
        """
        connection = self._client.socket()
        written, again = 0, False
        try:
            if connection is not None:
                written = connection.send(b"".join(packets))
        except (ssl.SSLWantWriteError, ssl.SSLWantReadError):
            again = True  # TLS has accepted the bytes and needs the same ones once more
        except OSError:  # the socket takes no more for now, or the connection is lost, which `loop_write` notices
            pass
        complete = 0
        while complete < len(packets) and written >= len(packets[complete]):
            written -= len(packets[complete])
            complete += 1
        if complete and self._tell_published is not None:
            self._tell_published(InFlight(0, self._loop.time(), None, complete), False)
        begun = len(packets) if again else min(complete + 1, len(packets))
        if begun > complete:
            self._write_later(b"".join(packets[complete:begun])[written:], begun - complete)
        return begun

    def _write_later(self, rest: bytes, messages: int) -> None:
        """Have the library write what is left of this many messages, as soon as the socket takes it."""
        library = self._client
        number = library._mid_generate()  # noqa: SLF001 - it has no public way to queue bytes
        now_s = self._loop.time()
        if not self.in_flight:
            self._progress_s = now_s
        self.in_flight[number] = InFlight(0, now_s, None, messages)
        self._sending = True
        try:
            library._packet_queue(PUBLISH, rest, number, 0, MQTTMessageInfo(number))  # noqa: SLF001
        finally:
            self._sending = False
        self._flush()

    def listen(self, topic_filter: str, qos: int = 1) -> None:
        """Ask for messages without waiting for the broker's word."""
        _, number = self._client.subscribe(topic_filter, qos)
        if number is not None:
            self._listened[number] = topic_filter

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

    def _client_connect(self) -> None:
        """Connect; in a thread of its own, as names are looked up, and files read that may have changed."""
        try:
            if self._broker.username is not None:
                self._client.username_pw_set(self._broker.username, self._broker.password)
            if self._broker.tls:
                self._client.tls_set_context(make_tls(self._broker))
            super()._client_connect()
        except OSError as error:
            raise refusals.of_opening(error, self._broker) from None

    async def _wait_for(self, fut: Awaitable[_Result], timeout: float | None) -> _Result:  # noqa: ASYNC109 - theirs
        try:
            return await super()._wait_for(fut, timeout)
        except aiomqtt.MqttError:
            if fut is self._connected and self._connected.cancelled():
                raise aiomqtt.MqttError(refusals.SILENT) from None
            raise

    def _on_disconnect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any = None) -> None:
        if self._connected.cancelled():  # the broker's word came too late, or nobody waits for it any more
            return
        if not self._connected.done():  # else the library would wait for an answer that cannot come
            self._connected.set_exception(refusals.of_silent_end(reason.value, self.version, self._broker))
        super()._on_disconnect(client, userdata, flags, reason, properties)

    def _on_connect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any = None) -> None:
        self.limits = limits_of(properties)
        if refused := refusals.WILL_LIMITS.get(reason.value):
            self.limits = self.limits._replace(**refused)
        super()._on_connect(client, userdata, flags, reason, properties)

    def _write_on(self) -> None:
        """Write what is left, as the socket takes some again."""
        self._progress_s = self._loop.time()
        self._flush()

    def _flush(self) -> None:
        self._client.loop_write()
        connection = self._client.socket()
        if isinstance(connection, socket.socket) and self._client.want_write() and self._writer is None:
            self._writer = connection
            self._loop.add_writer(connection, self._write_on)

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
        message = self.in_flight.pop(mid, None)
        if message is not None:
            self._progress_s = self._loop.time()
            self.unacknowledged -= message.qos
            if self._tell_published is not None:
                self._tell_published(message, reason.is_failure)

    def _subscribed(
        self, _client: object, _userdata: object, mid: int, reasons: list[Any], _properties: object
    ) -> None:
        topic_filter = self._listened.pop(mid, "")
        denied = [str(reason) for reason in reasons if reason.is_failure]
        if denied and self._tell_denied is not None:
            self._tell_denied(topic_filter, denied[0])

    def _received(self, _client: object, _userdata: object, message: Any) -> None:
        if self._tell_message is not None:
            asked = message.properties  # of MQTT 5, else None
            response_topic = getattr(asked, "ResponseTopic", None)
            correlation = getattr(asked, "CorrelationData", None)
            self._tell_message(Incoming(message.topic, message.payload, message.retain, response_topic, correlation))


def _log_line(level: int, text: str) -> None:
    log.log(level, "%s", text)


async def keep_connected(
    broker: Mqtt,
    make_client: Callable[[aiomqtt.ProtocolVersion], BrokerClient],
    serve: Callable[[BrokerClient], Awaitable[None]],
    closing: asyncio.Future[None],
    *,
    tell: Callable[[int, str], None] = _log_line,
) -> None:
    """Connect, serve until the connection is lost, and again with a fresh client, until `closing` is done.

    `serve` is cancelled when the connection is over; it raises MqttError to give the connection up. Only with
    `closing` the client takes its leave; in every other case the broker publishes its last will. `tell(level, text)`
    is called as the connection changes, once per change.
    """
    loop = asyncio.get_running_loop()
    pauses = Backoff(FIRST_PAUSE_S)
    version: aiomqtt.ProtocolVersion | None = None
    said = ""

    def say(level: int, text: str) -> None:
        nonlocal said
        if text != said:
            tell(level, f"broker {broker.host}:{broker.port}: {text}")
        said = text

    attempts = 0
    while not closing.done():
        attempts += 1
        longest_pause_s = LONGEST_PAUSE_S
        accepted = False
        try:
            version = version or await _find_version(broker, closing)
            if version is None:
                return
            client = await _open(make_client(version), closing)
            if client is None:
                return
            accepted = True
            client.at_once, attempts = attempts == 1, 0
            connected_s = loop.time()
            say(logging.INFO, f"connected, MQTT {'5' if version is aiomqtt.ProtocolVersion.V5 else '3.1.1'}")
            try:
                await _serve_until_over(serve, client, closing)
                if closing.done() and client.writable:
                    await client.__aexit__(None, None, None)
            finally:
                client.abort()
                if loop.time() - connected_s > STABLE_S:
                    pauses.start_anew()
        except (aiomqtt.MqttError, OSError) as caught:
            error = refusals.of_answer(caught, broker)
            refused = isinstance(error, refusals.RefusalError)
            if refused:
                longest_pause_s = REFUSED_PAUSE_S
            if broker.username is None or version is aiomqtt.ProtocolVersion.V311 or not (accepted or refused):
                version = None  # another broker may answer next time; else spared the question without a name
            said_by_broker = refusals.code_of(error) != _UNSPECIFIED
            say(logging.WARNING, f"{error if said_by_broker else 'connection lost'}; trying again")
        await asyncio.wait([closing], timeout=pauses.next_s(longest_pause_s))


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


async def _find_version(broker: Mqtt, closing: asyncio.Future[None]) -> aiomqtt.ProtocolVersion | None:
    """Ask for MQTT 5 with the plainest connection there is; None when closing comes first.

    A broker that does not know version 5 may misread a will, a name or a password in a connection of that version,
    and wait for the rest of it for ever, instead of refusing (amqtt 0.12 does). Any answer but "unsupported version" is
    one of MQTT 5, "not authorised" too.
    """
    try:
        probe = await _open(BrokerClient(broker.anonymous(), aiomqtt.ProtocolVersion.V5), closing)
    except aiomqtt.MqttCodeError as refusal:
        if refusals.code_of(refusal) == refusals.UNSUPPORTED_VERSION:
            return aiomqtt.ProtocolVersion.V311
    except refusals.NoAnswerError:
        if broker.username is None:
            raise
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
