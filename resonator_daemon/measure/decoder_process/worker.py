"""The decoder process: serves one request after the other, and encodes the messages about it."""

import gc
import pickle
from dataclasses import replace
from typing import Any, Final

from resonator_daemon.measure.decoder_process.decoder_connection import DecoderConnection
from resonator_daemon.measure.sensors.surface_requests import Reply, Results, SetUpStep, Undecodable
from resonator_daemon.measure.sensors.surface_worker import SurfaceWorker
from resonator_daemon.mqtt.codec import Encoded, encode
from resonator_daemon.mqtt.payloads import WITH_ARRAYS, ContactEvent, Header, Message

_FRAMES_TOGETHER: Final = 3  # that come before the next part of an update, which must not wait for ever


def work(connection: DecoderConnection) -> None:
    """Serve the settings, then requests, until the daemon's end is closed, or the sites cannot be decoded.

    EOFError or OSError when the daemon's end is closed.
    """
    ended = False
    failure: Exception | None = None  # of a request that was served within an update, which catches its own

    def send(reply: Reply) -> None:
        nonlocal ended
        ended = isinstance(reply, Undecodable)
        if isinstance(reply, SetUpStep) and not reply.step:
            gc.collect()
            gc.freeze()  # what was set up stays in use: collections that visit it take milliseconds
        if isinstance(reply, Results):
            reply = replace(reply, messages=tuple((path, _encoded(message)) for path, message in reply.messages))
        connection.send(reply)

    def serve_waiting() -> None:
        nonlocal failure
        try:
            for _ in range(_FRAMES_TOGETHER):
                if ended or failure or not (worker.is_behind or connection.has_message):
                    break
                worker.serve(connection.receive())
        except Exception as error:  # noqa: BLE001 - it is raised after the update
            failure = error

    worker = SurfaceWorker(connection.receive(), send, serve_waiting)
    send(Results((), "ready"))
    while not ended:
        worker.serve(connection.receive())
        if failure is not None:
            raise failure


def _encoded(message: Message | Encoded) -> Message | Encoded:
    """Encode a message of a stream; events are numbered by the daemon."""
    if isinstance(message, Header) and not isinstance(message, ContactEvent):
        payload: Any = encode(message)
        if isinstance(message, WITH_ARRAYS):
            payload = pickle.PickleBuffer(payload)  # an array to the connection, and bytes at its other end
        return Encoded(payload, message.t_ns)
    return message
