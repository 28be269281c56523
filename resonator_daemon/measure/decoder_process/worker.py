"""The decoder process: decodes one frame at a time and encodes the messages about it."""

import gc
import pickle
import socket
import time
from typing import Any, Final

from resonator_daemon.estimate.surface.streaming import UndecodableError
from resonator_daemon.measure.decoder_process.messages import (
    LENGTH,
    EndContacts,
    Outcome,
    Published,
    Reply,
    Request,
    Results,
    SetUpStep,
    Undecodable,
    Work,
    packed,
)
from resonator_daemon.measure.sensors.surface_stream import SurfaceSettings, SurfaceStream
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.headers import MeasuredFields
from resonator_daemon.mqtt.payloads import ContactEvent, Header, Message
from resonator_daemon.mqtt.topics import DECODED, Topic

AGE_MAX_NS: Final = 100_000_000  # of a frame that is decoded, since it was offered
_PAUSE: Final = 2.4  # between rebuilds, times as long as one took: rebuilds take at most 30 % of a core


def work(connection: socket.socket) -> None:
    """Serve the requests on a blocking stream socket until it is closed, or the sites cannot be decoded."""
    with connection, connection.makefile("rb") as requests:

        def receive() -> Request | None:
            head = requests.read(LENGTH.size)
            if len(head) < LENGTH.size:
                return None
            request: Request = pickle.loads(requests.read(*LENGTH.unpack(head)))
            return request

        settings = receive()
        if not isinstance(settings, SurfaceSettings):
            return
        worker = _Worker(connection, settings)
        while (request := receive()) is not None:
            try:
                worker.serve(request)
            except UndecodableError as error:
                connection.sendall(packed(Undecodable(str(error))))
                return


class _Worker:
    """Server of one request after the other."""

    def __init__(self, connection: socket.socket, settings: SurfaceSettings) -> None:
        self._connection = connection
        self._stream = SurfaceStream(settings, self._publish, self._report_step)
        self._messages: list[Published | ContactEvent] = []
        self._rebuild_from_ns = 0  # monotonic time from which the next rebuild may begin
        self._reply("ready")

    def serve(self, request: Request) -> None:
        match request:
            case Work():
                self._decode(request)
            case EndContacts():
                self._stream.end_contacts(lambda: _required(request.header), request.reason)
                self._reply("ready")

    def _decode(self, request: Work) -> None:
        if not self._stream.prepare(request.frame):
            self._reply("no_noise")
        elif time.monotonic_ns() - request.offered_ns > AGE_MAX_NS:
            self._reply("too_old")
        else:
            self._stream.decode(request.frame)
            self._reply("decoded")
            self._rebuild()

    def _rebuild(self) -> None:
        """Update the matrices for contacts that have moved; a frame that arrives meanwhile waits in the socket."""
        began_ns = time.monotonic_ns()
        if began_ns >= self._rebuild_from_ns and self._stream.rebuild():
            now_ns = time.monotonic_ns()
            self._rebuild_from_ns = now_ns + round(_PAUSE * (now_ns - began_ns))

    def _publish(self, topic: Topic[Any], message: Message) -> None:
        if isinstance(message, ContactEvent):
            self._messages.append(message)
        elif isinstance(message, Header):
            self._messages.append(Published(topic.path, encode(message), message.t_ns))
            if topic is DECODED:  # the map is sent before the contacts are read
                self._reply(None)

    def _report_step(self, step: str) -> None:
        if not step:
            gc.collect()
            gc.freeze()  # what was set up stays in use: collections that visit it take milliseconds
        self._send(SetUpStep(step))

    def _reply(self, outcome: Outcome | None) -> None:
        self._send(Results(tuple(self._messages), outcome))
        self._messages.clear()

    def _send(self, reply: Reply) -> None:
        self._connection.sendall(packed(reply))


def _required(header: MeasuredFields | None) -> MeasuredFields:
    if header is None:
        raise ValueError("contacts ended of which the daemon has received no event")
    return header
