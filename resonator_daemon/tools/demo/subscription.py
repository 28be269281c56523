"""Subscription to the demo's own broker: a thread that reads packets of MQTT 3.1.1 without decoding payloads.

A client library takes as much processor time for a message as the rest of the demo.
"""

import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from typing import Final
from urllib.parse import urlsplit

from resonator_daemon.base.errors import UserError, reason_of
from resonator_daemon.mqtt.embedded_broker import packet_ends
from resonator_daemon.mqtt.subscriber import Arrival

_CONNECT, _PUBLISH, _PUBACK, _SUBSCRIBE = b"\x10", 3, b"\x40\x02", b"\x82"
_CONNACK: Final = b"\x20\x02\x00\x00"
_PROTOCOL: Final = b"\x00\x04MQTT\x04\x02\x00\x00"  # version 3.1.1, a clean session, no keep-alive
_READ_BYTES: Final = 256 * 1024
_TIMEOUT_S: Final = 5.0


class Subscription:
    """Subscription from the construction to `close`; its thread calls `on_arrival` with each message.

    Parameters
    ----------
    url
        Broker, as `mqtt://HOST:PORT`.
    filters
        Topic filters and their QoS, 0 or 1.
    on_arrival
        Called with topic, payload and time of arrival of each message.

    Raises
    ------
    UserError
        The broker refuses the connection.
    """

    def __init__(self, url: str, filters: Mapping[str, int], on_arrival: Callable[[Arrival], None]) -> None:
        parts = urlsplit(url)
        self._on_arrival = on_arrival
        self._sending = threading.Lock()
        try:
            with ExitStack() as undo:
                address = (parts.hostname or "", parts.port or 1883)
                self._socket = undo.enter_context(socket.create_connection(address, _TIMEOUT_S))
                self._subscribe(filters)
                undo.pop_all()
        except OSError as error:
            raise UserError(f"the broker at {url} refuses the connection of the demo: {reason_of(error)}") from error
        self._thread = threading.Thread(target=self._receive, name="subscription", daemon=True)
        self._thread.start()

    def _subscribe(self, filters: Mapping[str, int]) -> None:
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.sendall(_packet(_CONNECT, _PROTOCOL + _text("demo")))
        if (answer := self._socket.recv(len(_CONNACK), socket.MSG_WAITALL)) != _CONNACK:
            raise ConnectionRefusedError(f"answer {answer.hex() or 'empty'} to CONNECT")
        self._socket.settimeout(None)
        wanted = b"".join(_text(topic_filter) + bytes([qos]) for topic_filter, qos in filters.items())
        self._socket.sendall(_packet(_SUBSCRIBE, b"\x00\x01" + wanted))

    def publish(self, topic: str, payload: bytes) -> None:
        """Publish a message with QoS 0; it is lost if the broker has closed the connection."""
        with suppress(OSError):
            self._send(_packet(bytes([_PUBLISH << 4]), _text(topic) + payload))

    def close(self) -> None:
        """Close the connection and wait for the thread."""
        with suppress(OSError):  # the broker has closed it already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _receive(self) -> None:
        waiting = b""
        try:
            while data := self._socket.recv(_READ_BYTES):
                arrived_ns = time.time_ns()
                waiting = self._deliver(waiting + data, arrived_ns)
        except OSError:
            pass  # the broker has ended; the demo notices that by its process

    def _deliver(self, data: bytes, arrived_ns: int) -> bytes:
        """Pass on the messages of all complete packets; return the rest of the bytes."""
        start = 0
        while (ends := packet_ends(data, start)) is not None:
            body, end = ends
            if data[start] >> 4 == _PUBLISH:
                topic_end = body + 2 + int.from_bytes(data[body : body + 2], "big")
                payload = topic_end
                if data[start] & 0b110:
                    payload += 2
                    self._send(_PUBACK + data[topic_end:payload])
                self._on_arrival(Arrival(data[body + 2 : topic_end].decode(), data[payload:end], arrived_ns))
            start = end
        return data[start:]

    def _send(self, packet: bytes) -> None:
        with self._sending:
            self._socket.sendall(packet)


def _packet(kind: bytes, body: bytes) -> bytes:
    length, head = len(body), bytearray(kind)
    while length > 127:
        head.append(length % 128 | 128)
        length //= 128
    return bytes(head) + bytes([length]) + body


def _text(words: str) -> bytes:
    return struct.pack(">H", len(words.encode())) + words.encode()
