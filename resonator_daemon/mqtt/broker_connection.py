"""One connection to a broker: paho-mqtt in an asyncio event loop, with non-waiting writes and exact counts."""

import asyncio
import concurrent.futures.thread  # noqa: F401 - imported while another thread forks, its fork hooks release a lock twice
import contextlib
import socket
import ssl
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.subscribeoptions import SubscribeOptions

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import connecting
from resonator_daemon.mqtt.codec import Incoming, Outgoing
from resonator_daemon.mqtt.connecting import BrokerError, make_tls
from resonator_daemon.mqtt.packets import PackedProperties, pack
from resonator_daemon.mqtt.topics import JSON

MQTT_5: Final = MQTTProtocolVersion.MQTTv5
NO_SUBSCRIBERS: Final = 0x10  # reason codes of MQTT 5
FAILURE: Final = 0x80  # and above
PACKET_BYTES_MAX: Final = 268_435_455 + 5  # largest that MQTT can encode
MQTT_3: Final = MQTTProtocolVersion.MQTTv311

_NO_DELAY: Final = (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else Nagle and delayed ACK add 40 ms now and then
# Else the system takes megabytes that a slow broker has not asked for, and what matters waits behind them.
_UNSENT_BYTES_MAX: Final = (socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, 128 * 1024)
_MESSAGES_TOGETHER_MAX: Final = 256  # then other tasks run
_REST: Final = 0  # key of the streams that are partly written; packet identifiers begin at 1

OnCompleted = Callable[["InFlight", int], None]
OnMessage = Callable[[Incoming], None]
OnDenied = Callable[[str, str], None]


@dataclass(frozen=True)
class ConnectionTimes:
    """Time limits and pauses of connections to a broker, in seconds."""

    keepalive_s: int = 5
    connect_s: float = 5.0
    progress_s: float = 5.0  # without any write or acknowledgement
    acknowledge_s: float = 20.0  # of one message, while others are acknowledged
    check_s: float = 1.0
    close_s: float = 2.0  # for messages that still wait when the publisher is closed
    first_pause_s: float = 0.1
    longest_pause_s: float = 0.6  # a broker that restarts has all states within a second
    refused_pause_s: float = 30.0  # longest one after a refusal: brokers log and ban clients that retry too often
    stable_s: float = 5.0  # the next attempts after a longer connection begin with the first pause


class InFlight(NamedTuple):
    """Messages that are partly written (QoS 0), or not acknowledged yet (QoS 1)."""

    qos: int
    since_s: float
    token: object  # the sender's
    messages: int = 1


class BrokerConnection:
    """One connection, from `connect` to `disconnect` or `abort`; to be used from the event loop's thread only.

    `send` and `send_streams` neither wait nor queue; the caller checks `writable` before.

    Parameters
    ----------
    broker
        Address and credentials.
    version
        Of MQTT.
    identifier
        Of the client; None: the broker or the library chooses one.
    will
        Message that the broker publishes if the connection ends without a DISCONNECT packet.
    on_completed
        Called with (messages, reason code) when QoS 0 messages are written in full, and when a QoS 1 message is
        acknowledged.
    on_writable
        Called when packets that the library had queued by itself, as an acknowledgement, are written and a message
        can follow.
    on_message
        Called with each received message.
    on_denied
        Called with (topic_filter, reason) when the broker refuses a subscription.
    times
    read_pause_s
        Between two readings while messages arrive, so that one reading receives several; 0: none.

    Attributes
    ----------
    receive_maximum
        Messages of QoS 1 that the broker takes before it has acknowledged them, once connected.
    packet_bytes_max
        Largest packet that the broker takes, once connected.
    lost
        Done when the connection has ended.
    socket
        The open socket, which the event loop watches; None without a connection.
    """

    def __init__(
        self,
        broker: Mqtt,
        version: MQTTProtocolVersion,
        *,
        identifier: str | None = None,
        will: Outgoing | None = None,
        on_completed: OnCompleted | None = None,
        on_writable: Callable[[], None] | None = None,
        on_message: OnMessage = lambda _: None,
        on_denied: OnDenied | None = None,
        times: ConnectionTimes | None = None,
        read_pause_s: float = 0.0,
    ) -> None:
        self._broker = broker
        self._read_pause_s = read_pause_s
        self._times = times or ConnectionTimes()
        self._loop = asyncio.get_running_loop()
        self.version = version
        self.receive_maximum = 65_535
        self.packet_bytes_max = PACKET_BYTES_MAX
        self.in_flight: dict[int, InFlight] = {}  # by packet identifier
        self.unacknowledged = 0
        self._accepted: asyncio.Future[None] = self._loop.create_future()
        self.lost: asyncio.Future[None] = self._loop.create_future()
        self._progress_s = 0.0
        self._subscribing: dict[int, tuple[str, asyncio.Future[str | None]]] = {}
        self._on_completed = on_completed
        self._on_writable = on_writable
        self._on_message = on_message
        self._on_denied = on_denied
        self._sending = False
        self.socket: socket.socket | None = None
        self._received = 0  # messages
        self._writing = False  # the event loop waits until the socket takes more
        self._rest = b""  # of stream packets that are partly written
        self._check: asyncio.TimerHandle | None = None
        self._client = client = Client(
            CallbackAPIVersion.VERSION2, client_id=identifier, protocol=version, reconnect_on_failure=False
        )
        client.connect_timeout = self._times.connect_s
        if will is not None:
            properties = None
            if version is MQTT_5:
                properties = pack(content_type=JSON, expiry_s=will.expiry_s, packet_type=PacketTypes.WILLMESSAGE)
            client.will_set(will.topic, will.payload, 1, will.retained, properties)
        client.on_connect = self._connack_received
        client.on_disconnect = self._disconnected
        client.on_publish = self._completed
        client.on_subscribe = self._suback_received
        client.on_socket_close = self._closing
        client.on_socket_register_write = self._write_wanted
        client.on_message = self._message_received

    @property
    def connected(self) -> bool:
        return self.socket is not None

    @property
    def writable(self) -> bool:
        """Whether a message would be written now, not queued."""
        return self.socket is not None and not self._rest and not self._client.want_write()

    @property
    def messages_in_flight(self) -> int:
        return sum(sent.messages for sent in self.in_flight.values())

    async def connect(self) -> None:
        """Open the connection, and wait until the broker accepts it.

        Raises
        ------
        BrokerError
            The broker cannot be reached, does not answer or refuses.
        """
        opening = self._loop.run_in_executor(None, self._open)  # looks names up and reads files, which block
        try:
            await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(self._discard)  # the thread cannot be interrupted
            raise
        except OSError as error:
            raise connecting.of_opening(error, self._broker) from None
        except UnicodeError as error:
            raise BrokerError(f"not a host name: {error}") from None
        try:
            self._attach()
            async with asyncio.timeout(self._times.connect_s):
                await self._accepted
            if not self.connected:
                raise BrokerError("the broker ended the connection at once")
        except TimeoutError:
            self.abort()
            raise connecting.SilentError(self._broker) from None
        except BaseException:
            self.abort()
            raise

    async def disconnect(self) -> None:
        """Send DISCONNECT, so that the broker does not publish the will, and wait until it is written."""
        self._client.disconnect()
        await asyncio.wait([self.lost], timeout=self._times.connect_s)
        self.abort()

    def abort(self) -> None:
        """End the connection without DISCONNECT: the broker publishes the will."""
        connection = self._client.socket()
        if isinstance(connection, socket.socket):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            self._client.disconnect()
            self._client.loop_write()  # fails, upon which the library closes the socket
        for future in (self._accepted, self.lost):
            if future.done() and not future.cancelled():
                future.exception()  # else asyncio reports that it was never retrieved

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

        Properties are left out with MQTT 3.1.1; those given packed take precedence over the two others.

        Raises
        ------
        ValueError
            The topic is none that can be published to.
        """
        if self.version is not MQTT_5:
            properties = None
        elif properties is None and (correlation is not None or response_topic is not None):
            properties = pack(correlation=correlation, response_topic=response_topic)
        self._sending = True
        try:
            info = self._client.publish(topic, payload, qos, retain, properties)
        finally:
            self._sending = False
        self._begin(info.mid, InFlight(qos, self._loop.time(), token))
        self.unacknowledged += qos
        self._flush()

    def send_streams(self, packets: Sequence[bytes]) -> tuple[int, int]:
        """Write whole PUBLISH packets of QoS 0 with one system call, only while `writable`.

        The unwritten rest of those that are begun is queued; what is not begun stays with the caller.

        Returns
        -------
        begun, complete
            Numbers of packets; of those that are not complete, `on_completed` reports the end.
        """
        data = b"".join(packets)
        sent = self._write(data)
        if sent == len(data):
            return len(packets), len(packets)
        if self.socket is None:
            return 0, 0
        left, complete = sent, 0
        while left >= len(packets[complete]):
            left -= len(packets[complete])
            complete += 1
        # TLS requires the same bytes again, because it may have begun to encrypt any of them.
        begun = len(packets) if isinstance(self.socket, ssl.SSLSocket) else complete + 1
        self._rest = data[sent : sent - left + sum(map(len, packets[complete:begun]))]
        self._begin(_REST, InFlight(0, self._loop.time(), None, begun - complete))
        self._watch_writable()
        return begun, complete

    def subscribe(
        self, topic_filter: str, qos: int = 1, *, retain_as_published: bool = False
    ) -> asyncio.Future[str | None]:
        """Subscribe, with options of MQTT 5; the result is the reason for which the broker refuses it, or None."""
        refused: asyncio.Future[str | None] = self._loop.create_future()
        if self.version is MQTT_5:
            options = SubscribeOptions(qos, retainAsPublished=retain_as_published)
            _, number = self._client.subscribe(topic_filter, options=options)
        else:
            _, number = self._client.subscribe(topic_filter, qos)
        if number is None:
            refused.set_result("no connection")
        else:
            self._subscribing[number] = (topic_filter, refused)
        return refused

    def unsubscribe(self, topic_filters: Sequence[str]) -> None:
        self._client.unsubscribe(list(topic_filters))

    def _open(self) -> None:
        """Connect the socket, TLS included; in a thread."""
        if self._broker.username is not None:
            self._client.username_pw_set(self._broker.username, self._broker.password)
        if self._broker.tls:
            self._client.tls_set_context(make_tls(self._broker))
        self._client.connect(self._broker.host, self._broker.port, self._times.keepalive_s)

    def _discard(self, opening: asyncio.Future[None]) -> None:
        if not opening.cancelled():
            opening.exception()
        self.abort()

    def _attach(self) -> None:
        """Watch the socket in the event loop."""
        connection = self._client.socket()
        if not isinstance(connection, socket.socket):
            raise BrokerError("the broker ended the connection at once")
        for option in (_NO_DELAY, _UNSENT_BYTES_MAX):
            connection.setsockopt(*option)
        self.socket = connection
        self._loop.add_reader(connection, self._read_together if self._read_pause_s else self._read)
        self._check = self._loop.call_later(self._times.check_s, self._check_times)
        self._flush()

    def _check_times(self) -> None:
        """Send a ping if one is due; end the connection if the broker is frozen, or gone without closing it."""
        self._check = self._loop.call_later(self._times.check_s, self._check_times)
        self._client.loop_misc()
        oldest = next(iter(self.in_flight.values()), None)
        if oldest is not None and self.connected:
            now_s = self._loop.time()
            if now_s - self._progress_s > self._times.progress_s or now_s - oldest.since_s > self._times.acknowledge_s:
                self._end(BrokerError("no answer"))

    def _end(self, error: Exception) -> None:
        if not self.lost.done():
            self.lost.set_exception(error)
        self.abort()

    def _read(self) -> None:
        try:
            self._client.loop_read()
            while isinstance(self.socket, ssl.SSLSocket) and self.socket.pending():
                self._client.loop_read()
        except Exception as error:  # noqa: BLE001 - a defect in a callback; `lost` raises it
            self._end(error)

    def _read_together(self) -> None:
        """Read all messages that have arrived; while some do, do so again after a pause instead of at once."""
        before = received = self._received
        for _ in range(_MESSAGES_TOGETHER_MAX):
            self._read()
            if self._received == received:
                break
            received = self._received
        if self.socket is None:
            return
        number = self.socket.fileno()  # with the socket itself, asyncio makes a text of it each time
        if received == before:
            self._loop.add_reader(number, self._read_together)
        else:
            self._loop.remove_reader(number)
            self._loop.call_later(self._read_pause_s, self._read_together)

    def _write_on(self) -> None:
        self._progress_s = self._loop.time()
        self._write_queued()

    def _write_queued(self) -> None:
        self._flush()
        if self._on_writable is not None and self.writable:
            self._on_writable()

    def _flush(self) -> None:
        """Write the rest of streams first, then the packets that the library has queued."""
        if self._rest:
            self._rest = self._rest[self._write(self._rest) :]
            if not self._rest:
                self._complete(_REST, 0)
        if not self._rest:
            self._client.loop_write()
        self._watch_writable()

    def _write(self, data: bytes) -> int:
        """Return how many bytes the socket took."""
        try:
            return self.socket.send(data) if self.socket is not None else 0
        except OSError:  # it is full, or the connection is lost, which `_read` notices
            return 0

    def _watch_writable(self) -> None:
        wanted = bool(self._rest) or self._client.want_write()
        if self.socket is not None and wanted is not self._writing:
            self._writing = wanted
            if wanted:
                self._loop.add_writer(self.socket, self._write_on)
            else:
                self._loop.remove_writer(self.socket)

    def _write_wanted(self, *_: object) -> None:
        """Write what the library has queued by itself; `connect` does so for CONNECT, which a thread has queued."""
        if self.socket is not None and not self._sending:
            self._loop.call_soon(self._write_queued)

    def _closing(self, _client: object, _userdata: object, connection: Any) -> None:
        """Stop watching the socket, which the library closes next."""
        if self.socket is not None:
            self._loop.remove_reader(connection)
            if self._writing:
                self._loop.remove_writer(connection)
        self.socket, self._writing, self._rest = None, False, b""
        if self._check is not None:
            self._check.cancel()

    def _connack_received(
        self, _client: object, _userdata: object, _flags: object, reason: Any, properties: Any
    ) -> None:
        self.receive_maximum = getattr(properties, "ReceiveMaximum", self.receive_maximum)
        self.packet_bytes_max = getattr(properties, "MaximumPacketSize", self.packet_bytes_max)
        if self._accepted.done():
            return
        if reason.is_failure:
            self._accepted.set_exception(BrokerError(str(reason), code=reason.value))
        else:
            self._accepted.set_result(None)

    def _disconnected(self, _client: object, _userdata: object, _flags: object, reason: Any, _: object) -> None:
        for _topic_filter, refused in self._subscribing.values():
            if not refused.done():
                refused.set_result("connection lost")
        self._subscribing.clear()
        if not self._accepted.done():
            self._accepted.set_exception(connecting.of_silent_end(reason.value, self.version, self._broker))
        elif not self.lost.done() and reason.is_failure:
            self.lost.set_exception(BrokerError(str(reason), code=reason.value))
        elif not self.lost.done():
            self.lost.set_result(None)

    def _completed(self, _client: object, _userdata: object, number: int, reason: Any, _: object) -> None:
        self._complete(number, reason.value)

    def _begin(self, number: int, messages: InFlight) -> None:
        if not self.in_flight:
            self._progress_s = messages.since_s
        self.in_flight[number] = messages

    def _complete(self, number: int, reason_code: int) -> None:
        messages = self.in_flight.pop(number, None)
        if messages is not None:
            self._progress_s = self._loop.time()
            self.unacknowledged -= messages.qos
            if self._on_completed is not None:
                self._on_completed(messages, reason_code)

    def _suback_received(
        self, _client: object, _userdata: object, number: int, reasons: list[Any], _properties: object
    ) -> None:
        topic_filter, refused = self._subscribing.pop(number)
        denied = next((str(reason) for reason in reasons if reason.is_failure), None)
        if not refused.done():
            refused.set_result(denied)
        if denied is not None and self._on_denied is not None:
            self._on_denied(topic_filter, denied)

    def _message_received(self, _client: object, _userdata: object, message: Any) -> None:
        self._received += 1
        asked = message.properties  # of MQTT 5, else None
        response_topic = getattr(asked, "ResponseTopic", None)
        correlation = getattr(asked, "CorrelationData", None)
        self._on_message(Incoming(message.topic, message.payload, message.retain, response_topic, correlation))
