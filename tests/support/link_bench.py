"""Every kind of link with a board at its other end; over USB the host is a process of its own."""

import ast
import os
import select
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from firmware_protocol.device import DeviceSession
from firmware_protocol.messages import CounterKind, Description, Identity
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.links.link import Link, LinkLostError, LinkUnavailableError
from simulators import links as device_links
from simulators.usb_link import UsbLink

SERIAL_NUMBER = "0042"
LINK = f"usb:1209:0001?serial={SERIAL_NUMBER}"

_HOST = """
import sys, traceback
scope = {}
for line in sys.stdin:
    kind, source = line[0], eval(line[1:])
    try:
        answer = "=" + repr(eval(source, scope) if kind == "?" else exec(source, scope))
    except Exception as error:
        answer = f"!{type(error).__name__}: {error}"
    print(answer, flush=True)
"""


class HostError(Exception):
    """What the host's process has raised, as `Type: text`."""


class UsbHost:
    """A Python process that sees the emulated bus; statements and expressions are run in it, one at a time."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _HOST],
            env={**os.environ, **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, source: str) -> None:
        self._ask("!", source)

    def value(self, expression: str) -> object:
        """Return the value of an expression that is made of literals."""
        return ast.literal_eval(self._ask("?", expression))

    def begin(self, kind: str, source: str) -> None:
        """Start a statement (`!`) or an expression (`?`), to be followed by `end`."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{kind}{source!r}\n")
        self._process.stdin.flush()

    def end(self) -> str:
        assert self._process.stdout is not None
        readable, _, _ = select.select([self._process.stdout], [], [], WAIT_S)
        assert readable, "the host's process does not answer"
        answer = self._process.stdout.readline()
        if answer[:1] != "=":
            raise HostError(answer[1:].strip())
        return answer[1:]

    def close(self) -> None:
        """End it as a process ends that has nothing more to do."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        assert self._process.wait(WAIT_S) == 0
        self._process.stdout.close()

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()

    def _ask(self, kind: str, source: str) -> str:
        self.begin(kind, source)
        return self.end()


@contextmanager
def usb_host(link: UsbLink) -> Iterator[UsbHost]:
    host = UsbHost(link.environment)
    try:
        yield host
        host.close()
    finally:
        host.kill()


WAIT_S = 20.0  # to wait for what must come: ends a test that hangs

IDENTITY = Identity("conformance board", "0042", "1.0", 0, credit_bytes=512)
DESCRIPTION = Description(CounterKind.SINGLE_TONE, 4, 1, 10**11, 10_000, 10_000_000, "quartz16")

L = TypeVar("L", bound=device_links.Link)


class BoardEnd(Generic[L]):
    """A board's end of a link, in a thread: answers requests, sends what it is given, counts beginnings."""

    def __init__(self, make_link: Callable[[Callable[[], None]], L]) -> None:
        self.session = DeviceSession(IDENTITY, DESCRIPTION, boot_id=0x1234)
        self.answers = threading.Event()  # cleared: it receives nothing, not even the request to begin again
        self.answers.set()
        self.begins = 0
        self.received = b""
        self.link = make_link(self._begin)
        self._unsent = bytearray()
        self._orders: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._wake_read, self._wake_write = os.pipe()
        self._ending = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def send(self, data: bytes) -> None:
        self._order(lambda: self._unsent.extend(data))

    def unplug(self) -> None:
        self._order(self.link.hang_up)
        self._order(self._unsent.clear)

    def plug_in(self) -> None:
        self._order(self.link.plug_in)

    def wait(self, condition: Callable[[], bool]) -> None:
        """Wait until something is so of this end."""
        with self._changed:
            assert self._changed.wait_for(condition, WAIT_S)

    def close(self) -> None:
        self.answers.set()
        self._order(self._end)
        self._thread.join()
        self.link.close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _order(self, order: Callable[[], None]) -> None:
        with self._changed:
            self._orders.append(order)
            os.write(self._wake_write, b"x")
            assert self._changed.wait_for(lambda: not self._orders, WAIT_S)

    def _end(self) -> None:
        self._ending = True

    def _begin(self) -> None:
        self.begins += 1
        self.session.begin()
        self._unsent.clear()

    def _run(self) -> None:
        while not self._ending:
            self.answers.wait()
            write_fd = self.link.write_fd
            writers = [write_fd] if self._unsent and write_fd is not None else []
            readable, writable, _ = select.select([self._wake_read, *self.link.read_fds], writers, [])
            with self._changed:
                hears = self.answers.is_set()
                if hears and any(descriptor in readable for descriptor in self.link.read_fds):
                    data = self.link.read()
                    self.received += data
                    self._unsent += self.session.receive(data, 0)
                if hears and writable:
                    del self._unsent[: self.link.write(bytes(self._unsent))]
                if self._wake_read in readable:
                    os.read(self._wake_read, 1)
                    self._orders[0]()
                    self._orders.popleft()
                self._changed.notify_all()


class Host(Protocol):
    """The process that opens the link."""

    def open(self) -> Link: ...

    def descriptors(self) -> int:
        """Return how many it has open, while no link is."""


class LocalHost:
    """This process; where the board's end is in it, too, that must have let go before descriptors are counted."""

    def __init__(self, link: str, board: BoardEnd[Any] | None = None) -> None:
        self._target = parse_link(link)
        self._board = board

    def open(self) -> Link:
        return self._target.open()

    def descriptors(self) -> int:
        board = self._board
        if board is not None and isinstance(board.link, device_links.TcpLink):
            board.wait(lambda: board.link.write_fd is None)
        return len(os.listdir("/proc/self/fd"))


class RemoteHost:
    """A process that sees the emulated bus; its links are used from here."""

    def __init__(self, host: UsbHost, link: str) -> None:
        self._host = host
        self._opened = 0
        host.run("import os")
        host.run("from resonator_daemon.board.links.carriers import parse_link")
        host.run(f"target = parse_link({link!r})")

    def open(self) -> Link:
        self._opened += 1
        name = f"link{self._opened}"
        _told(lambda: self._host.run(f"{name} = target.open()"))
        return _RemoteLink(self._host, name)

    def descriptors(self) -> int:
        return int(str(self._host.value("len(os.listdir('/proc/self/fd'))")))


class _RemoteLink:
    def __init__(self, host: UsbHost, name: str) -> None:
        self._host = host
        self._name = name

    @property
    def overruns(self) -> int:
        return int(str(self._host.value(f"{self._name}.overruns")))

    def read(self, timeout_s: float) -> bytes:
        data = _told(lambda: self._host.value(f"{self._name}.read({timeout_s})"))
        assert isinstance(data, bytes)
        return data

    def write(self, data: bytes) -> None:
        _told(lambda: self._host.run(f"{self._name}.write({data!r})"))

    def close(self) -> None:
        self._host.run(f"{self._name}.close()")


def _told(use: Callable[[], object]) -> object:
    try:
        return use()
    except HostError as error:
        kind, _, text = str(error).partition(": ")
        errors = {"LinkLostError": LinkLostError, "LinkUnavailableError": LinkUnavailableError}
        if kind in errors:
            raise errors[kind](ReasonCode.UNSPECIFIED, text) from None
        raise


class Bench:
    """A link under test: the host that opens it, and the board behind it."""

    def __init__(self, host: Host, board: BoardEnd[Any]) -> None:
        self.host = host
        self.board = board


@contextmanager
def bench(kind: str, directory: Path) -> Iterator[Bench]:
    """Set up a board on a link of this kind: serial, tcp or usb."""
    makers: dict[str, Callable[[Callable[[], None]], device_links.Link]] = {
        "serial": lambda _begin: device_links.PtyLink(directory / "board"),
        "tcp": lambda _begin: device_links.TcpLink("127.0.0.1", 0, lambda: True),
        "usb": lambda begin: UsbLink(IDENTITY.serial_number, begin),
    }
    board: BoardEnd[Any] = BoardEnd(makers[kind])
    with ExitStack() as ending:
        ending.callback(board.close)
        if isinstance(board.link, UsbLink):
            host = ending.enter_context(usb_host(board.link))
            yield Bench(RemoteHost(host, board.link.address), board)
        else:
            yield Bench(LocalHost(board.link.address, board), board)
