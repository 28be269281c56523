"""Plates followed frame after frame: surfaces, contacts and events, as of a daemon that decodes itself."""

import asyncio
import math
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Final, TypeVar

from threadpoolctl import threadpool_limits

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.estimate.surface.decoder_setup import EqualSkins
from resonator_daemon.extensions.remote_decoding.plate import RemotePlate, frame_of, header_of
from resonator_daemon.extensions.remote_decoding.plates import Publish, RemotePlates
from resonator_daemon.measure.decoder_process.supervisor import DecoderSupervisor
from resonator_daemon.measure.pipeline.board_pipeline import CONTACTS_END_S
from resonator_daemon.measure.sensors.surface_decoding import Origin, Skipped, SurfaceClient, SurfaceDecoding
from resonator_daemon.measure.sensors.surface_worker import Reply, SurfaceSettings, SurfaceWorker
from resonator_daemon.mqtt.codec import Encoded, Incoming
from resonator_daemon.mqtt.payloads import ContactEvent, DecoderPlateHealth, DecoderProcessInfo, Lost, Message, Signals
from resonator_daemon.mqtt.topics import CONTACT_EVENT, HeaderFields, Topic

LOOK_S: Final = 0.1

Result = TypeVar("Result")


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


class ThreadDecoding(SurfaceDecoding[Origin]):
    """Decoding by a thread that several plates share, one frame each in turn; to be used from the event loop only."""

    def __init__(
        self, settings: SurfaceSettings, client: SurfaceClient[Origin], name: str, thread: DecodingThread
    ) -> None:
        super().__init__(settings, client, name)
        self._thread = thread
        self._loop = asyncio.get_running_loop()
        self._worker = SurfaceWorker(settings, self._send, thread.skins.set_up)
        self._has_work = asyncio.Event()

    async def run(self) -> None:
        """Decode until cancelled, or until the set-up finds that the sites cannot be decoded."""
        try:
            while not self._undecodable:
                await self._has_work.wait()
                async with self._thread.turns:
                    if (request := self._next_request()) is not None:
                        await self._thread.run(partial(self._worker.serve, request))
                    else:
                        self._has_work.clear()
        finally:
            self._skip_all()

    def _wake(self) -> None:
        self._has_work.set()

    def _send(self, reply: Reply) -> None:
        self._loop.call_soon_threadsafe(self._received, reply)


class FollowedPlate(RemotePlate):
    """Plate whose frames one decoder receives in order; it skips those that it has no time for."""

    def __init__(self, name: str, plates: "FollowedPlates") -> None:
        super().__init__(name, plates.make_settings)
        self._plates = plates
        self._changed = asyncio.Event()
        self._events = 0
        self._contacts_ended_s = -math.inf
        self._skips: Counter[Skipped] = Counter()  # of all its decoders
        self.decoding: SurfaceDecoding[Signals] | None = None

    @property
    def waiting(self) -> int:
        return self.decoding.waiting if self.decoding is not None else 0

    def health(self) -> DecoderPlateHealth:
        without_noise = self._skips["no_noise"]
        skipped, unusable = self._skips.total() - without_noise, self.unusable + without_noise
        return super().health().model_copy(update={"skipped": skipped, "unusable": unusable})

    def read_info(self, payload: bytes) -> bool:
        if not super().read_info(payload):
            return False
        self.is_decoded = False
        self._changed.set()
        return True

    def offer(self, signals: Signals) -> None:
        """Decode usable signals as soon as can be; skip those that arrive before there is a decoder."""
        if self.decoding is None or self._changed.is_set():
            self._skips["not_ready"] += 1
        else:
            self.decoding.offer(signals, frame_of(signals))

    def end_silent_contacts(self) -> None:
        """Release the contacts if no signals have arrived for some time."""
        is_silent = time.monotonic() - self.last_s > CONTACTS_END_S
        if self.decoding is not None and is_silent and self.last_s > self._contacts_ended_s:
            self._contacts_ended_s = self.last_s
            self.decoding.interrupt(Reason(ReasonCode.NO_SIGNALS, f"no signals for {CONTACTS_END_S:g} s"))

    async def run(self) -> None:
        """Decode until cancelled; another `info` starts another decoder."""
        last_contact_id = 0
        while True:
            self._changed.clear()
            if self.settings is None:
                await self._changed.wait()
            else:
                last_contact_id = await self._decode(replace(self.settings, last_contact_id=last_contact_id))

    async def _decode(self, settings: SurfaceSettings) -> int:
        """Decode until the plate has changed; return the number of the last contact."""
        decoding = self.decoding = self._plates.decoding_of(self, settings)
        decoding.skipped = self._skips
        self.note, self.is_refused = None, False
        running = asyncio.create_task(decoding.run(), name="decoding")
        changed = asyncio.create_task(self._changed.wait())
        try:
            await asyncio.wait((running, changed), return_when=asyncio.FIRST_COMPLETED)
            if running.done():
                running.result()
                self.is_refused = True  # the reason is its last announcement
                await changed
        finally:
            changed.cancel()
            running.cancel()
            await asyncio.wait((running, changed))
            self.decoding = None
            stopped = Reason(ReasonCode.STOPPED, "the decoder stopped")
            other_plate = Reason(ReasonCode.PLATE_CHANGED, "the plate has changed")
            decoding.release_contacts(other_plate if self._changed.is_set() else stopped)
        return decoding.last_contact_id

    def announce(self, note: Reason | None) -> None:
        """Report what is being set up, or why nothing is decoded."""
        self.note = note
        self.is_decoded = note is None and not self._changed.is_set()

    def lost(self, origin: Signals) -> Lost:
        """Return the daemon's losses, as the signals state them."""
        return origin.lost

    def contacts_header(self, origin: Signals) -> HeaderFields:
        """Return the header of one more message on `contacts`."""
        return header_of(origin)

    def deliver(self, origin: Signals, topic: Topic[Any], message: Message | Encoded) -> None:
        """Publish a message about decoded signals."""
        self._plates.deliver(self, origin, topic, message)

    def deliver_event(self, origin: Signals, event: ContactEvent) -> None:
        """Publish an event of a contact."""
        self.deliver(origin, CONTACT_EVENT, event.model_copy(update={"seq": self._events}))
        self._events += 1


class FollowedPlates(RemotePlates[FollowedPlate]):
    """Decoder of one plate in a child process, or of those that the configuration lists in a thread."""

    def __init__(self, config: DecoderConfig, decoder_id: str, publish: Publish) -> None:
        super().__init__(config, decoder_id, publish)
        self._thread = DecodingThread() if config.decoding.plates else None
        self.plates = {name: FollowedPlate(name, self) for name in self.names}

    def decoding_of(self, plate: FollowedPlate, settings: SurfaceSettings) -> SurfaceDecoding[Signals]:
        """Return a decoder of a plate, whose `run` is to be called."""
        if self._thread is None:
            return DecoderSupervisor(settings, plate, plate.name)
        return ThreadDecoding(settings, plate, plate.name, self._thread)

    def process_info(self) -> DecoderProcessInfo | None:
        decoders = (plate.decoding for plate in self.plates.values())
        return next((each.info() for each in decoders if isinstance(each, DecoderSupervisor)), None)

    async def run(self) -> None:
        with threadpool_limits(1, user_api="blas"):  # as in the daemon's decoder
            try:
                async with asyncio.TaskGroup() as tasks:
                    for plate in self.plates.values():
                        tasks.create_task(plate.run())
                    tasks.create_task(self._end_silent_contacts())
            finally:
                if self._thread is not None:
                    await self._thread.end()

    async def _end_silent_contacts(self) -> None:
        while True:
            await asyncio.sleep(LOOK_S)
            for plate in self.plates.values():
                plate.end_silent_contacts()

    def _receive_info(self, message: Incoming) -> None:
        if (plate := self.plates.get(self._name(message))) is not None:
            plate.read_info(message.payload)

    def _offer(self, plate: FollowedPlate, signals: Signals) -> None:
        plate.offer(signals)
