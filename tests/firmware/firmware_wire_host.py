"""A host that is no daemon: the protocol's session on a bare port, read when the test wants it to be."""

import fcntl
import os
import select
import socket
import struct
import termios
import time
import tty
from collections.abc import Callable
from typing import Any, Self

from listener import DEADLINE_S

from firmware_protocol.host import Described, HostEvent, HostSession, Started
from firmware_protocol.messages import Configuration
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.carriers.tcp import TcpTarget

ASK_AGAIN_S = 0.3


class WireHost:
    """Events in the order in which they came."""

    def __init__(self, link: SerialTarget | TcpTarget) -> None:
        if isinstance(link, TcpTarget):
            self._descriptor = socket.create_connection((link.host, link.port)).detach()
        else:
            self._descriptor = os.open(link.path, os.O_RDWR | os.O_NOCTTY)
            tty.setraw(self._descriptor)
        self.session = HostSession()
        self.events: list[HostEvent] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)

    def send(self, data: bytes = b"") -> None:
        """Write what the session has to say, and `data` behind it."""
        os.write(self._descriptor, self.session.data_to_send() + data)

    def read_once(self) -> None:
        ready, _, _ = select.select([self._descriptor], [], [], ASK_AGAIN_S)
        if ready:
            self.events += self.session.receive(os.read(self._descriptor, 1 << 16))
        else:
            self.session.ask_again()
            self.session.ping(b"are you?")  # a board that started anew says so only when it is asked
        self.send()

    def wait_for(self, kind: Any, enough: Callable[[Any], bool] = lambda event: True) -> Any:
        """Read until an event of this class, or union of classes, came, from where the last wait ended; return it."""
        deadline = time.monotonic() + DEADLINE_S
        while True:
            while self.events:
                event = self.events.pop(0)
                if isinstance(event, kind) and enough(event):
                    return event
            assert time.monotonic() < deadline, f"no {kind}"
            self.read_once()

    def start(self, gate_ticks: int = 1_000_000) -> Described:
        self.send()
        described = self.wait_for(Described)
        self.session.configure(Configuration(gate_ticks))
        self.send()
        self.wait_for(Started)
        return described

    def wait_until_full(self) -> None:
        """Read nothing until no more bytes fit in between."""
        waiting = -1
        while waiting != (waiting := self._waiting_bytes()):
            time.sleep(0.3)  # more than the board's queue holds

    def _waiting_bytes(self) -> int:
        number: int = struct.unpack("i", fcntl.ioctl(self._descriptor, termios.FIONREAD, b"\0" * 4))[0]
        return number
