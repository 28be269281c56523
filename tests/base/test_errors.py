"""Errors of the operating system in plain words: without numbers, addresses of asyncio and files of Python."""

import asyncio
import errno
import socket

import pytest
from brokers import free_port

from resonator_daemon.base.errors import reason_of


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
    ],
)
def test_an_error_has_its_meaning_alone(error: OSError, words: str) -> None:
    assert reason_of(error) == words


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
async def test_a_refused_connection_has_neither_number_nor_address(host: str) -> None:
    with pytest.raises(OSError) as refused:  # noqa: PT011 - asyncio has a class of its own for several addresses
        await asyncio.open_connection(host, free_port())
    assert reason_of(refused.value) == "Connection refused"
