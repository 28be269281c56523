"""A host for emulated boards, in a test's own hands: reads until stopped."""

import json
import os
import select
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from firmware_protocol.host import Described, Frame, HostEvent, HostSession
from firmware_protocol.messages import Configuration

WAIT_S = 20.0  # after which a test fails; none waits that long
_SILENCE_S = 0.1  # after which a host asks


class Host:
    """Reads an emulated board until stopped."""

    def __init__(self, fd: int, gate_ticks: int) -> None:
        self.fd = fd
        self._gate_ticks = gate_ticks
        self.session = HostSession()
        self.events: list[HostEvent] = []
        self.gone = False

    def read_until(self, done: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + WAIT_S
        while not done():
            if request := self.session.data_to_send():
                os.write(self.fd, request)
            readable, _, _ = select.select([self.fd], [], [], _SILENCE_S)
            assert time.monotonic() < deadline_s, f"did not happen within {WAIT_S} s"
            if not readable:
                self.session.ask_again()
                self.session.ping(b"anybody?")
                continue
            try:
                data = os.read(self.fd, 1 << 20)
            except OSError:  # EIO of a terminal that was pulled, or a reset connection
                data = b""
            if not data:
                self.gone = True
                return
            for event in self.session.receive(data):
                if isinstance(event, Described):
                    self.session.configure(Configuration(self._gate_ticks))
                self.events.append(event)

    @property
    def frames(self) -> list[Frame]:
        return [event for event in self.events if isinstance(event, Frame)]


@contextmanager
def opened(path: Path, gate_ticks: int = 1_000_000) -> Iterator[Host]:
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        yield Host(fd, gate_ticks)
    finally:
        os.close(fd)


def wait_for(done: Callable[[], bool]) -> None:
    """Look again and again: a file system tells nobody."""
    deadline_s = time.monotonic() + WAIT_S
    while not done():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def truths(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
