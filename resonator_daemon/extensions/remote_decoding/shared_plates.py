"""Many plates whose frames many decoders share: the broker delivers each frame to one of them."""

import asyncio
import logging
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from threadpoolctl import threadpool_limits

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.board.config.tables import plate_name
from resonator_daemon.estimate.surface.decoder_setup import CANNOT_DECODE, set_up
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder, SurfaceReading, rounded_noise
from resonator_daemon.estimate.surface.streaming import failed
from resonator_daemon.extensions.remote_decoding.plate import NO_INFO, MakeSettings, RemotePlate, error_text, frame_of
from resonator_daemon.extensions.remote_decoding.plates import Publish, RemotePlates
from resonator_daemon.measure.sensors.surface_worker import SurfaceFrame, SurfaceSettings
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.payloads import Condition, Signals
from resonator_daemon.mqtt.topics import CONTACTS, DECODED, DECODED_SUMMARY

PLATES_MAX: Final = 1000
PROBLEMS_MAX: Final = 100  # of plates that are not in the table
NAME_LENGTH_MAX: Final = 100
REPLACED_AFTER_S: Final = 60.0  # without messages, by another plate
DECODERS_MAX: Final = 4  # of some 80 MB; equal skins share one

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Frame:
    message: Signals
    frame: SurfaceFrame
    settings: SurfaceSettings


class SharedPlate(RemotePlate):
    """Plate of which this process receives some frames.

    Attributes
    ----------
    added_s
        When it was added, by the monotonic clock.
    newest
        Its frame that waits; None if none does.
    is_busy
        Whether a frame of it is being decoded.
    """

    def __init__(self, name: str, make_settings: MakeSettings) -> None:
        super().__init__(name, make_settings)
        self.added_s = time.monotonic()
        self.newest: _Frame | None = None
        self.is_busy = False

    @property
    def waiting(self) -> int:
        return self.is_busy + (self.newest is not None)


class SharedPlates(RemotePlates[SharedPlate]):
    """Decoder of each frame by itself, as the broker delivers them to this process: no contact ids, no events.

    Decoding runs in a thread. Signals that arrive while it is busy replace waiting ones of the same plate. A plate
    is there from its first `info` with a skin until its `info` is withdrawn.

    Parameters
    ----------
    config
        With the names of the plates, or "+" alone for all below the prefix, and the group whose decoders share frames.
    decoder_id, publish
        As of `RemotePlates`.
    """

    def __init__(self, config: DecoderConfig, decoder_id: str, publish: Publish) -> None:
        super().__init__(config, decoder_id, publish)
        self._queue: dict[SharedPlate, None] = {}  # plates with a frame that waits, the next one first
        self._offered = asyncio.Event()
        self._decoders: list[tuple[tuple[object, ...], SkinDecoder]] = []  # by geometry, the one used last at the end
        self._step: Reason | None = None  # of a set-up
        self._problems: dict[str, Reason] = {}  # of plates that were not added, the oldest first
        self._is_full = False

    def condition(self) -> tuple[Condition, Reason]:
        return (Condition.STARTING, self._step) if self._step is not None else super().condition()

    def _conditions(self) -> dict[str, tuple[Condition, Reason]]:
        return super()._conditions() | {name: (Condition.WAITING, why) for name, why in self._problems.items()}

    async def run(self) -> None:
        pool = ThreadPoolExecutor(1, thread_name_prefix="decoding")
        with threadpool_limits(1, user_api="blas"):  # as in the daemon's decoder
            try:
                while True:
                    await self._offered.wait()
                    self._offered.clear()
                    while self._queue:
                        await self._decode_next(pool)
            finally:
                for plate in self.plates.values():
                    plate.skipped += plate.waiting
                    plate.newest, plate.is_busy = None, False
                self._queue.clear()
                await asyncio.to_thread(pool.shutdown)

    def _offer(self, plate: SharedPlate, signals: Signals) -> None:
        if plate.settings is not None:
            plate.skipped += plate.newest is not None
            plate.newest = _Frame(signals, frame_of(signals), plate.settings)
            self._queue[plate] = None
            self._offered.set()

    async def _decode_next(self, pool: ThreadPoolExecutor) -> None:
        plate = next(iter(self._queue))
        del self._queue[plate]
        frame, plate.newest, plate.is_busy = plate.newest, None, True
        if frame is None:
            raise ValueError("no frame waits")
        decoder = await self._decoder_for(plate, frame, pool)
        if not plate.is_busy:  # it was removed meanwhile
            return
        if decoder is None:
            plate.unusable += 1
            plate.is_busy = False
            return
        plate.is_decoded = frame.settings is plate.settings
        reading = await asyncio.get_running_loop().run_in_executor(pool, _decode, decoder, frame.frame)
        if plate.is_busy:
            plate.is_busy = False
            self._publish_reading(plate, frame, reading)

    async def _decoder_for(self, plate: SharedPlate, frame: _Frame, pool: ThreadPoolExecutor) -> SkinDecoder | None:
        skin, noise_std = frame.settings.skin, frame.frame.noise_std
        geometry = skin.geometry()
        for index, (known, decoder) in enumerate(self._decoders):
            if known == geometry and decoder.fits(noise_std):
                self._decoders.append(self._decoders.pop(index))
                return decoder
        built_for = rounded_noise(skin, noise_std)
        if built_for is None:
            return None
        loop, started_s = asyncio.get_running_loop(), time.monotonic()

        def progress(step: str) -> None:
            log.info("decoder is being set up: %s", step)
            starting = Reason(ReasonCode.DECODER_STARTING, f"decoder is being set up: {step}")
            loop.call_soon_threadsafe(setattr, self, "_step", starting)

        try:
            decoder = await loop.run_in_executor(pool, set_up, skin, self._options, built_for, progress)
        except CANNOT_DECODE as error:
            log.error("%s: nothing is decoded: %s", plate.name, error_text(error))
            plate.refuse(Reason(ReasonCode.UNDECODABLE, f"nothing is decoded: {error_text(error)}"))
            return None
        finally:
            self._step = None
        log.info(
            "decoder %s for skins as of %s ready after %.1f s", decoder.name, plate.name, time.monotonic() - started_s
        )
        if len(self._decoders) == DECODERS_MAX:
            del self._decoders[0]
            log.warning("more than %d different skins or noises: decoders are set up again and again", DECODERS_MAX)
        self._decoders.append((geometry, decoder))
        return decoder

    def _publish_reading(self, plate: SharedPlate, frame: _Frame, surface: SurfaceReading) -> None:
        message, header, messages = frame.message, frame.frame.header, frame.settings.messages()
        self.deliver(plate, message, DECODED, messages.decoded(header, surface.decoded))
        self.deliver(plate, message, DECODED_SUMMARY, messages.summary(header, surface, numbered=False))
        self.deliver(plate, message, CONTACTS, messages.contacts(header, surface, numbered=False))

    def _receive_info(self, message: Incoming) -> None:
        name = self._name(message)
        if not _is_plate(name):
            return
        self._problems.pop(name, None)
        if not message.payload:
            self._remove(name)
        elif name in self.plates:
            if self.plates[name].read_info(message.payload):
                self.plates[name].is_decoded = False
        else:
            plate = SharedPlate(name, self.make_settings)
            plate.read_info(message.payload)
            if plate.settings is None:
                self._add_problem(name, plate.problem or NO_INFO)
            elif self._has_room(name):
                self.plates[name] = plate
            else:
                text = f"is beyond {PLATES_MAX} plates; name the plates of each group in decoding.plates"
                self._add_problem(name, Reason(ReasonCode.NO_SIGNALS, text))

    def _has_room(self, name: str) -> bool:
        """Return whether a plate can be added, if necessary instead of the one that has been silent for longest."""
        if len(self.plates) < PLATES_MAX:
            self._is_full = False
            return True
        silent_s, silent = min((max(plate.last_s, plate.added_s), known) for known, plate in self.plates.items())
        if time.monotonic() - silent_s > REPLACED_AFTER_S:
            self._remove(silent)
            return True
        if not self._is_full:
            log.warning("more than %d plates: %s and others are not decoded", PLATES_MAX, name)
        self._is_full = True
        return False

    def _add_problem(self, name: str, problem: Reason) -> None:
        if len(self._problems) >= PROBLEMS_MAX:
            del self._problems[next(iter(self._problems))]
        self._problems[name] = problem

    def _remove(self, name: str) -> None:
        """Remove a plate with its waiting frame, and the result of one that is being decoded."""
        if (plate := self.plates.pop(name, None)) is not None:
            self._queue.pop(plate, None)
            plate.newest, plate.is_busy = None, False


def _is_plate(name: str) -> bool:
    try:
        return len(name) <= NAME_LENGTH_MAX and name not in (".", "..") and plate_name(name) == name
    except ValueError:
        return False


def _decode(decoder: SkinDecoder, frame: SurfaceFrame) -> SurfaceReading:
    try:
        return decoder.decode_alone(frame.signals, frame.noise_std)
    except Exception as error:  # noqa: BLE001  an error of one frame must not stop the next
        return failed(decoder, error)
