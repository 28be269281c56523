"""The decoder process: serves one request after the other, and encodes the messages about it."""

import gc
import pickle
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final

from resonator_daemon.measure.decoder_process.channel import Channel
from resonator_daemon.measure.sensors.surface_requests import Reply, Results, SetUpStep, Undecodable
from resonator_daemon.measure.sensors.surface_worker import SurfaceWorker
from resonator_daemon.mqtt.codec import Encoded, encode
from resonator_daemon.mqtt.payloads import WITH_ARRAYS, ContactEvent, Header, Message

_FRAMES_TOGETHER: Final = 3  # that come before the next part of an update, which must not wait for ever


def work(channel: Channel) -> None:
    """Serve the settings, then requests, until the daemon's end is closed, or the sites cannot be decoded.

    EOFError or OSError when the daemon's end is closed.
    """
    ended = False

    def send(reply: Reply) -> None:
        nonlocal ended
        ended = isinstance(reply, Undecodable)
        if isinstance(reply, SetUpStep) and not reply.step:
            gc.collect()
            gc.freeze()  # what was set up stays in use: collections that visit it take milliseconds
        if isinstance(reply, Results):
            reply = replace(reply, messages=tuple((path, _encoded(message)) for path, message in reply.messages))
        channel.send(reply)

    def serve_waiting() -> None:
        with suppress(EOFError, OSError):  # which the next `receive` raises again
            for _ in range(_FRAMES_TOGETHER):
                if ended or not (worker.is_behind or channel.has_message):
                    break
                worker.serve(channel.receive())

    worker = SurfaceWorker(channel.receive(), send, serve_waiting)
    send(Results((), "ready"))
    while not ended:
        worker.serve(channel.receive())


def _encoded(message: Message | Encoded) -> Message | Encoded:
    """Encode a message of a stream; events are numbered by the daemon."""
    if isinstance(message, Header) and not isinstance(message, ContactEvent):
        payload: Any = encode(message)
        if isinstance(message, WITH_ARRAYS):
            payload = pickle.PickleBuffer(payload)  # an array to the channel, and bytes at its other end
        return Encoded(payload, message.t_ns)
    return message
