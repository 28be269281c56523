"""Errors of the operating system in plain words: without numbers, addresses of asyncio and files of Python."""

import errno
import socket

import pytest

from resonator_daemon.base.errors import reason_of

ADDRESS = ("127.0.0.1", 5000)  # as asyncio has it in its words


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOENT, "No such file or directory", "/a"), "/a: No such file or directory"),
        (
            OSError(errno.EMFILE, "Too many open files", "/lib/idna.py"),
            "Too many open files; raise the limit (ulimit -n)",
        ),
        (socket.gaierror(socket.EAI_NONAME, "Name or service not known"), "Name or service not known"),
        (TimeoutError(), "no answer in time"),
        (TimeoutError("timed out"), "no answer in time"),
        (OSError("[Errno 5] read failed"), "Input/output error"),
        (OSError(), "OSError"),
        (OSError(errno.ECONNREFUSED, f"Connect call failed {ADDRESS}"), "Connection refused"),
        (OSError(f"Multiple exceptions: [Errno 111] Connect call failed {ADDRESS}, [Errno 111]"), "Connection refused"),
    ],
)
def test_an_error_has_its_meaning_alone(error: OSError, words: str) -> None:
    assert reason_of(error) == words
