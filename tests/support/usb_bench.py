"""A host in a process of its own that sees an emulated USB device."""

import ast
import os
import select
import subprocess
import sys
from collections.abc import Iterator, Mapping
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
