"""Decoding of several plates in one thread: each frame continues from the previous one of its plate."""

import asyncio
import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Generic, Literal, TypeVar

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.equal_skins import EqualSkins
from resonator_daemon.estimate.surface.streaming import UndecodableError
from resonator_daemon.measure.decoder_process.supervisor import WAIT_MAX_NS
from resonator_daemon.measure.decoder_process.worker import AGE_MAX_NS
from resonator_daemon.measure.sensors.surface_decoding import SurfaceClient
from resonator_daemon.measure.sensors.surface_stream import SurfaceFrame, SurfaceSettings, SurfaceStream
from resonator_daemon.mqtt.codec import Encoded, encode
from resonator_daemon.mqtt.payloads import ContactEvent, DecoderProcessInfo, Header, Message
from resonator_daemon.mqtt.topics import DECODED, Topic

Skipped = Literal["newer_frame", "too_old", "no_noise", "decoder_ended", "undecodable"]
Origin = TypeVar("Origin")
Result = TypeVar("Result")

log = logging.getLogger(__name__)


class DecodingThread:
    """Thread that sets up and runs the decoders of several plates in turn; equal skins share their matrices."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="decoding")
        self.turns = asyncio.Semaphore(2)  # in order of request: one frame is decoded, one is next
        self.skins = EqualSkins()

    async def run(self, work: Callable[[], Result]) -> Result:
        """Run work in the thread and return its result; if cancelled, wait until running work has ended."""
        future = self._executor.submit(work)
        try:
            return await asyncio.wrap_future(future)
        except asyncio.CancelledError:
            if not future.cancel():
                await asyncio.wait([asyncio.wrap_future(future)])
            raise

    async def end(self) -> None:
        """Stop the thread; wait until running work has ended."""
        await asyncio.to_thread(self._executor.shutdown)


class ThreadDecoding(Generic[Origin]):
    """Decoder of one plate, with the interface of `DecoderSupervisor`; to be used from the event loop's thread only.

    Plates take turns, one frame each. Frames wait in order; one that has waited for more than 30 ms is skipped if there
    is a newer one.

    Parameters
    ----------
    name
        Name of the plate, for the log.
    settings
        Settings of the decoder.
    client
        Receiver of the messages.
    thread
        Thread that all plates share.

    Attributes
    ----------
    skipped
        Number of frames that were not decoded, by cause.
    last_contact_id
        The highest contact id so far.
    """

    def __init__(
        self, name: str, settings: SurfaceSettings, client: SurfaceClient[Origin], thread: DecodingThread
    ) -> None:
        self._name = name
        self._client = client
        self._thread = thread
        self._loop = asyncio.get_running_loop()
        self._stream = SurfaceStream(settings, self._publish, self._report_step, thread.skins.set_up)
        self._waiting: deque[tuple[Origin, SurfaceFrame, int]] = deque()  # with the time of its offer, in ns
        self._present: Origin | None = None  # of the frame in the thread, until its map is published
        self._last: Origin | None = None  # of the frame that the thread received last
        self._has_work = asyncio.Event()
        self._interruption: Reason | None = None
        self._undecodable = False
        self.skipped: Counter[Skipped] = Counter()
        self.last_contact_id = settings.last_contact_id

    @property
    def waiting(self) -> int:
        """Number of frames that are being decoded or wait."""
        return (self._present is not None) + len(self._waiting)

    @property
    def frames_skipped(self) -> int:
        """Number of frames that were not decoded."""
        return self.skipped.total()

    def info(self) -> DecoderProcessInfo | None:
        """Return None: there is no child process."""
        return None

    def offer(self, origin: Origin, frame: SurfaceFrame) -> None:
        """Queue a frame for decoding; it is skipped if it waits for more than 30 ms and a newer one waits."""
        if self._undecodable:
            self.skipped["undecodable"] += 1
            return
        self._waiting.append((origin, frame, time.monotonic_ns()))
        self._skip_old()
        self._has_work.set()

    def interrupt(self, reason: Reason) -> None:
        """Release all contacts, because frames have stopped arriving."""
        self._interruption = reason
        self._has_work.set()

    def release_contacts(self, reason: Reason) -> None:
        """Release all contacts after `run` has ended, and publish that there are none."""
        if self._last is not None:
            header = self._client.contacts_header(self._last)
            self._stream.end_contacts(lambda: header, reason)

    async def run(self) -> None:
        """Decode until cancelled, or until the set-up finds that the sites cannot be decoded."""
        try:
            while not self._undecodable:
                await self._has_work.wait()
                async with self._thread.turns:
                    await self._take_turn()
        finally:
            self.skipped["undecodable" if self._undecodable else "decoder_ended"] += len(self._waiting)
            self._waiting.clear()

    async def _take_turn(self) -> None:
        if self._interruption is not None:
            reason, self._interruption = self._interruption, None
            await self._thread.run(partial(self.release_contacts, reason))
        elif self._waiting:
            self._skip_old()
            await self._decode(*self._waiting.popleft())
        else:
            self._has_work.clear()

    async def _decode(self, origin: Origin, frame: SurfaceFrame, offered_ns: int) -> None:
        self._present = self._last = origin
        frame.header["lost"] = self._client.lost(origin)
        skipped: Skipped | None = "decoder_ended"
        try:
            skipped = await self._thread.run(partial(self._decode_in_thread, frame, offered_ns))
        finally:
            if skipped is not None and self._present is not None:
                self.skipped[skipped] += 1
            self._present = None

    def _decode_in_thread(self, frame: SurfaceFrame, offered_ns: int) -> Skipped | None:
        """Decode a frame; return the cause if it is skipped."""
        try:
            is_ready = self._stream.prepare(frame)
        except UndecodableError as error:
            self._undecodable = True
            log.error("%s: nothing is decoded: %s", self._name, error)
            self._announce(Reason(ReasonCode.UNDECODABLE, f"nothing is decoded: {error}"))
            return "undecodable"
        if not is_ready:
            return "no_noise"
        if time.monotonic_ns() - offered_ns > AGE_MAX_NS:
            return "too_old"
        self._stream.decode(frame)
        return None

    def _skip_old(self) -> None:
        """Skip frames that have waited for more than 30 ms, except the newest."""
        oldest_ns = time.monotonic_ns() - WAIT_MAX_NS
        while len(self._waiting) > 1 and self._waiting[0][2] < oldest_ns:
            self._waiting.popleft()
            self.skipped["newer_frame"] += 1

    def _publish(self, topic: Topic[Any], message: Message) -> None:
        """Deliver a message on the event loop."""
        encoded = Encoded(encode(message), message.t_ns) if isinstance(message, Header) else message
        is_event = isinstance(message, ContactEvent)
        self._loop.call_soon_threadsafe(self._deliver, topic, message if is_event else encoded)

    def _deliver(self, topic: Topic[Any], message: Message | Encoded) -> None:
        if self._last is None:
            raise ValueError("message before the first frame")
        if isinstance(message, ContactEvent):
            self.last_contact_id = max(self.last_contact_id, message.contact.id)
            self._client.deliver_event(self._last, message)
            return
        if topic is DECODED:
            self._present = None
        self._client.deliver(self._last, topic, message)

    def _report_step(self, step: str) -> None:
        log.info("decoder of %s %s", self._name, f"is being set up: {step}" if step else "is ready")
        self._announce(Reason(ReasonCode.DECODER_STARTING, f"decoder is being set up: {step}") if step else None)

    def _announce(self, note: Reason | None) -> None:
        self._loop.call_soon_threadsafe(self._client.announce, note)
