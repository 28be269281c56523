"""The decoder process: serves one request after the other, and encodes the messages about it.

On the socket, each request and reply is pickled, after its length. The settings come first, and once.
"""

import gc
import pickle
import socket
import struct
from dataclasses import replace
from typing import Final

from resonator_daemon.measure.sensors.surface_worker import (
    Reply,
    Request,
    Results,
    SetUpStep,
    SurfaceSettings,
    SurfaceWorker,
    Undecodable,
)
from resonator_daemon.mqtt.codec import Encoded, encode
from resonator_daemon.mqtt.payloads import ContactEvent, Header, Message

LENGTH: Final = struct.Struct("<I")  # bytes


def packed(message: SurfaceSettings | Request | Reply) -> bytes:
    """Return a message in its form on the socket."""
    content = pickle.dumps(message, protocol=5)
    return LENGTH.pack(len(content)) + content


def work(connection: socket.socket) -> None:
    """Serve the requests on a blocking stream socket until it is closed, or the sites cannot be decoded."""
    ended = False

    def send(reply: Reply) -> None:
        nonlocal ended
        ended = isinstance(reply, Undecodable)
        if isinstance(reply, SetUpStep) and not reply.step:
            gc.collect()
            gc.freeze()  # what was set up stays in use: collections that visit it take milliseconds
        if isinstance(reply, Results):
            reply = replace(reply, messages=tuple((path, _encoded(message)) for path, message in reply.messages))
        connection.sendall(packed(reply))

    with connection, connection.makefile("rb") as requests:
        worker: SurfaceWorker | None = None
        while not ended and len(head := requests.read(LENGTH.size)) == LENGTH.size:
            request: SurfaceSettings | Request = pickle.loads(requests.read(*LENGTH.unpack(head)))
            if isinstance(request, SurfaceSettings):
                worker = SurfaceWorker(request, send)
                send(Results((), "ready"))
            elif worker is not None:
                worker.serve(request)


def _encoded(message: Message | Encoded) -> Message | Encoded:
    """Encode a message of a stream; events are numbered by the daemon."""
    if isinstance(message, Header) and not isinstance(message, ContactEvent):
        return Encoded(encode(message), message.t_ns)
    return message
