"""An emulated USB device with a board's end in a thread, and a host in a process of its own that sees it."""

import ast
import os
import select
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from simulators.usb_link import UsbLink

SERIAL_NUMBER = "0042"
LINK = f"usb:1209:0001?serial={SERIAL_NUMBER}"
WAIT_S = 20.0  # for what happens at once on any machine that is not stuck

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


class UsbBoardEnd:
    """The board's end: sends what it is given, keeps what comes, counts beginnings."""

    def __init__(self) -> None:
        self.link = UsbLink(SERIAL_NUMBER, self._begin)
        self.answers = threading.Event()  # cleared: it hears nothing, not even that it is to begin anew
        self.answers.set()
        self.begins = 0
        self.received = b""
        self._unsent = b""
        self._changed = threading.Condition()
        self._wake_read_fd, self._wake_write_fd = os.pipe()
        self._ending = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def send(self, data: bytes) -> None:
        with self._changed:
            self._unsent += data
        os.write(self._wake_write_fd, b"x")

    def wait(self, condition: Callable[[], bool]) -> None:
        """Wait until something is so of this end."""
        with self._changed:
            assert self._changed.wait_for(condition, WAIT_S)

    def all_written(self) -> bool:
        return not self._unsent

    def close(self) -> None:
        self._ending = True
        self.answers.set()
        os.write(self._wake_write_fd, b"x")
        self._thread.join()
        self.link.close()
        os.close(self._wake_read_fd)
        os.close(self._wake_write_fd)

    def _begin(self) -> None:
        self.begins += 1
        self._unsent = b""

    def _run(self) -> None:
        while not self._ending:
            self.answers.wait()
            write_fd = self.link.write_fd
            writers = [write_fd] if self._unsent and write_fd is not None else []
            readable, writable, _ = select.select([self._wake_read_fd, *self.link.read_fds], writers, [])
            with self._changed:
                if self._wake_read_fd in readable:
                    os.read(self._wake_read_fd, 1)
                if not self.answers.is_set():
                    continue
                if any(fd in readable for fd in self.link.read_fds):
                    self.received += self.link.read()
                if writable:
                    self._unsent = self._unsent[self.link.write(self._unsent) :]
                self._changed.notify_all()


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
def usb_board() -> Iterator[UsbBoardEnd]:
    board = UsbBoardEnd()
    try:
        yield board
    finally:
        board.close()


@contextmanager
def usb_host(board: UsbBoardEnd) -> Iterator[UsbHost]:
    host = UsbHost(board.link.environment)
    try:
        yield host
        host.close()
    finally:
        host.kill()
