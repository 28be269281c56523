"""Many plates whose frames many decoders share: the broker delivers each frame to one of them."""

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.board.config.tables import plate_name
from resonator_daemon.daemon.remote_decoding.plate import (
    NO_SIGNALS,
    WAITS_AFTER_S,
    Publish,
    RemotePlate,
    SkinPlate,
    error_text,
    header_of,
)
from resonator_daemon.estimate.surface.decoder_setup import CANNOT_DECODE, set_up
from resonator_daemon.estimate.surface.skin import DecodingOptions
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder, SurfaceReading, rounded_noise
from resonator_daemon.estimate.surface.streaming import failed
from resonator_daemon.measure.latency import LatencyHistogram
from resonator_daemon.measure.sensors.surface_messages import SurfaceMessages
from resonator_daemon.mqtt.mqtt_messages import Incoming
from resonator_daemon.mqtt.payloads import Condition, DecoderPlateHealth, DecoderProcessInfo, Signals
from resonator_daemon.mqtt.publisher import Subscription
from resonator_daemon.mqtt.topics import (
    CONTACTS,
    DECODED,
    DECODED_SUMMARY,
    INFO,
    SIGNALS,
    full_topic,
    split_topic,
)

PLATES_MAX: Final = 1000
PROBLEMS_MAX: Final = 100  # of plates that are not in the table
NAME_LENGTH_MAX: Final = 100
REPLACED_AFTER_S: Final = 60.0  # without messages, by another plate
DECODERS_MAX: Final = 4  # of some 80 MB; equal skins share one
TOGETHER_MAX: Final = 16  # frames of equal skins whose maps are computed together

_PROBLEMS_NAMED = 3  # in the reason of a state

Origin = TypeVar("Origin")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Frame(Generic[Origin]):
    origin: Origin
    skin: SkinPlate
    signals: Floats
    noise_std: Floats
    shows_load: bool = False  # by a map that was computed together with others


class SharedStage(Generic[Origin]):
    """Decoder in a separate thread; signals that arrive while it is busy replace waiting ones of the same plate.

    Waiting frames of equal skins are decoded together; those that show a load wait again, and are decoded one by one.

    Parameters
    ----------
    options
        Options of the decoders, without background: no decoder receives enough frames of a plate to follow it.
    deliver
        Called on the event loop with the plate, the `origin` that `offer` received, and the reading.
    announce
        Called on the event loop with the present step of a set-up, and with None at its end.
    refuse
        Called on the event loop with a plate that cannot be decoded, and the reason.

    Attributes
    ----------
    skipped, unusable
        Number of frames by plate: replaced by a newer one; with unknown noise, or of a refused plate.
    served
        By plate, the skin of the last frame for which a decoder was set up.
    """

    def __init__(
        self,
        options: DecodingOptions,
        deliver: Callable[[str, Origin, SurfaceReading], None],
        announce: Callable[[Reason | None], None],
        refuse: Callable[[str, Reason], None],
    ) -> None:
        self._options = options
        self._deliver = deliver
        self._announce = announce
        self._refuse = refuse
        self._newest: dict[str, _Frame[Origin]] = {}  # by plate, the next one first
        self._busy_with: set[str] = set()
        self._offered = asyncio.Event()
        self._decoders: list[tuple[tuple[object, ...], SkinDecoder]] = []  # by geometry, the one used last at the end
        self.skipped: Counter[str] = Counter()
        self.unusable: Counter[str] = Counter()
        self.served: dict[str, SkinPlate] = {}

    def waiting(self, plate: str) -> int:
        """Return the number of frames of a plate that are being decoded, or wait."""
        return (plate in self._busy_with) + (plate in self._newest)

    def offer(self, plate: str, origin: Origin, skin: SkinPlate, signals: Floats, noise_std: Floats) -> None:
        """Queue one frame of a plate, both arrays (3, sites); return at once."""
        self.skipped[plate] += plate in self._newest
        self._newest[plate] = _Frame(origin, skin, signals, noise_std)
        self._offered.set()

    def discard(self, plate: str) -> None:
        """Discard the counters and waiting frames of a plate, and the result of one that is being decoded."""
        self._newest.pop(plate, None)
        self.served.pop(plate, None)
        del self.skipped[plate], self.unusable[plate]
        self._busy_with.discard(plate)

    async def run(self) -> None:
        """Decode until cancelled."""
        pool = ThreadPoolExecutor(1, thread_name_prefix="decoding")
        with threadpool_limits(1, user_api="blas"):  # as in the daemon's decoder
            try:
                while True:
                    await self._offered.wait()
                    self._offered.clear()
                    while self._newest:
                        await self._decode_next(pool)
            finally:
                self.skipped.update(self._newest.keys())
                self.skipped.update(self._busy_with)
                self._newest, self._busy_with = {}, set()
                await asyncio.to_thread(pool.shutdown)

    async def _decode_next(self, pool: ThreadPoolExecutor) -> None:
        plate = next(iter(self._newest))
        frame = self._newest.pop(plate)
        self._busy_with = {plate}
        decoder = await self._decoder_for(plate, frame, pool)
        if not self._busy_with:  # the plate was removed meanwhile
            return
        if decoder is None:
            self.unusable[plate] += 1
            self._busy_with.clear()
            return
        frames = {plate: frame} | ({} if frame.shows_load else self._alike(frame, decoder))
        for name in frames.keys() - {plate}:
            del self._newest[name]
        self._busy_with = set(frames)
        self.served |= {name: each.skin for name, each in frames.items()}
        readings = await asyncio.get_running_loop().run_in_executor(pool, _decode, decoder, list(frames.values()))
        for (name, each), reading in zip(frames.items(), readings, strict=True):
            if name not in self._busy_with:
                continue
            self._busy_with.remove(name)
            if reading is not None:
                self._deliver(name, each.origin, reading)
            elif name in self._newest:  # a newer frame takes its turn
                self.skipped[name] += 1
            else:
                self._newest[name] = replace(each, shows_load=True)

    def _alike(self, frame: _Frame[Origin], decoder: SkinDecoder) -> dict[str, _Frame[Origin]]:
        """Return waiting frames, by plate, that the decoder of this frame can decode with it."""
        geometry = frame.skin.geometry
        alike = (
            (name, each)
            for name, each in self._newest.items()
            if not each.shows_load and each.skin.geometry == geometry and decoder.fits(each.noise_std)
        )
        return dict(islice(alike, TOGETHER_MAX - 1))

    async def _decoder_for(self, plate: str, frame: _Frame[Origin], pool: ThreadPoolExecutor) -> SkinDecoder | None:
        geometry = frame.skin.geometry
        for index, (known, decoder) in enumerate(self._decoders):
            if known == geometry and decoder.fits(frame.noise_std):
                self._decoders.append(self._decoders.pop(index))
                return decoder
        noise_std = rounded_noise(frame.skin.skin, frame.noise_std)
        if noise_std is None:
            return None
        loop, started = asyncio.get_running_loop(), time.monotonic()

        def progress(step: str) -> None:
            log.info("decoder is being set up: %s", step)
            starting = Reason(ReasonCode.DECODER_STARTING, f"decoder is being set up: {step}")
            loop.call_soon_threadsafe(self._announce, starting)

        try:
            decoder = await loop.run_in_executor(pool, set_up, frame.skin.skin, self._options, noise_std, progress)
        except CANNOT_DECODE as error:
            log.error("%s: nothing is decoded: %s", plate, error_text(error))
            self._announce(None)
            if self._busy_with:
                self._refuse(plate, Reason(ReasonCode.UNDECODABLE, f"nothing is decoded: {error_text(error)}"))
            return None
        self._announce(None)
        log.info("decoder %s for skins as of %s ready after %.1f s", decoder.name, plate, time.monotonic() - started)
        if len(self._decoders) == DECODERS_MAX:
            del self._decoders[0]
            log.warning("more than %d different skins or noises: decoders are set up again and again", DECODERS_MAX)
        self._decoders.append((geometry, decoder))
        return decoder


def _decode(decoder: SkinDecoder, frames: Sequence[_Frame[Any]]) -> Sequence[SurfaceReading | None]:
    """Decode a frame, or those among several that show no load; None for the others."""
    try:
        if len(frames) == 1:
            return [decoder.decode_alone(frames[0].signals, frames[0].noise_std)]
        signals, noise_std = (np.array([getattr(f, key) for f in frames]) for key in ("signals", "noise_std"))
        return decoder.decode_untouched(signals, noise_std)
    except Exception as error:  # noqa: BLE001  an error of one frame must not stop the next
        return [failed(decoder, error)] if len(frames) == 1 else [None] * len(frames)


class _Origin(NamedTuple):
    signals: Signals
    reporter: SurfaceMessages


class SharedPlates:
    """Decoder of each frame by itself, as the broker delivers them to this process: no contact ids, no events.

    Parameters
    ----------
    config
        With the names of the plates, or "+" alone for all below the prefix, and the group whose decoders share frames.
    options, decoder_id, publish
        As of `FollowedPlate`.
    """

    def __init__(self, config: DecoderConfig, options: DecodingOptions, decoder_id: str, publish: Publish) -> None:
        self._prefix = config.mqtt.prefix
        self._decoding = config.decoding
        self._names = config.decoding.plates or ()
        self._decoder_id = decoder_id
        self._publish = publish
        self._plates: dict[str, RemotePlate] = {}
        self._reporters: dict[str, SurfaceMessages] = {}
        self._stage = SharedStage[_Origin](options, self._deliver, self._announce, self._refuse)
        self._note: Reason | None = None
        self._added_s: dict[str, float] = {}
        self._problems: dict[str, str] = {}  # of plates that were not added, the oldest first
        self._is_full = False
        self.latency = LatencyHistogram()
        self.topic_filter = " ".join(self._filter(name, SIGNALS.path) for name in self._names)

    @property
    def subscriptions(self) -> Sequence[Subscription]:
        infos = [
            Subscription(full_topic(self._prefix, name, INFO.path), INFO.qos, self._receive_info)
            for name in self._names
        ]
        signals = [Subscription(self._filter(name, SIGNALS.path), 0, self._receive_signals) for name in self._names]
        return (*infos, *signals)

    def condition(self) -> tuple[Condition, Reason]:
        """Return the present state and its reason."""
        if self._note:
            return Condition.STARTING, self._note
        now_s = time.monotonic()
        served = self._stage.served
        live = [
            plate
            for plate in self._plates.values()
            if now_s - plate.last_s <= WAITS_AFTER_S and plate.skin and served.get(plate.name) is plate.skin
        ]
        problems = [f"{plate.name}: {plate.problem.text}" for plate in self._plates.values() if plate.problem]
        problems += [f"{name}: {problem}" for name, problem in self._problems.items()]
        if len(problems) > _PROBLEMS_NAMED:
            problems[_PROBLEMS_NAMED:] = [f"and {len(problems) - _PROBLEMS_NAMED} more"]
        what = f"signals of {len(live)} plates are decoded" if live else NO_SIGNALS.text
        full = [f"{PLATES_MAX} plates are known, no more are taken"] if len(self._plates) >= PLATES_MAX else []
        text = "; ".join((what, *full, *problems))
        if live:
            return Condition.ONLINE, Reason(ReasonCode.DECODING, text)
        return Condition.WAITING, Reason(NO_SIGNALS.code, text)

    def health(self) -> dict[str, DecoderPlateHealth]:
        """Return the counters of each plate's signals."""
        return {
            name: plate.health(
                waiting=self._stage.waiting(name),
                skipped=self._stage.skipped[name],
                unusable=self._stage.unusable[name],
            )
            for name, plate in self._plates.items()
        }

    def process_info(self) -> DecoderProcessInfo | None:
        """Return None: this process has no child that decodes."""
        return None

    async def run(self) -> None:
        """Decode until cancelled."""
        await self._stage.run()

    def _filter(self, name: str, path: str) -> str:
        return f"$share/{self._decoding.group}/{full_topic(self._prefix, name, path)}"

    def _name(self, message: Incoming) -> str | None:
        """Return the plate of a message; None if its topic contains no valid name of a plate."""
        name, _ = split_topic(self._prefix, message.topic)
        if len(name) > NAME_LENGTH_MAX or name in (".", ".."):
            return None
        try:
            return plate_name(name)
        except ValueError:
            return None

    def _receive_info(self, message: Incoming) -> None:
        name = self._name(message)
        if name is None:
            return
        self._problems.pop(name, None)
        if not message.payload:
            self._remove(name)
            return
        if name in self._plates:
            if self._plates[name].read_info(message.payload):
                self._reporters.pop(name, None)
            return
        plate = RemotePlate(name)
        plate.read_info(message.payload)
        if not plate.skin:
            self._add_problem(name, plate.problem.text if plate.problem else "")
        elif self._has_room(name):
            self._plates[name], self._added_s[name] = plate, time.monotonic()
        else:
            self._add_problem(name, f"is beyond {PLATES_MAX} plates; name the plates of each group in decoding.plates")

    def _has_room(self, name: str) -> bool:
        """Return whether a plate can be added, if necessary instead of the one that has been silent for longest."""
        if len(self._plates) < PLATES_MAX:
            self._is_full = False
            return True
        silent_s, silent = min(
            (max(plate.last_s, self._added_s[known]), known) for known, plate in self._plates.items()
        )
        if time.monotonic() - silent_s > REPLACED_AFTER_S:
            self._remove(silent)
            return True
        if not self._is_full:
            log.warning("more than %d plates: %s and others are not decoded", PLATES_MAX, name)
        self._is_full = True
        return False

    def _add_problem(self, name: str, problem: str) -> None:
        if len(self._problems) >= PROBLEMS_MAX:
            del self._problems[next(iter(self._problems))]
        self._problems[name] = problem

    def _remove(self, name: str) -> None:
        if self._plates.pop(name, None) is None:
            return
        del self._added_s[name]
        self._reporters.pop(name, None)
        self._stage.discard(name)

    def _receive_signals(self, message: Incoming) -> None:
        name = self._name(message)
        plate = None if name is None else self._plates.get(name)
        if plate is None:
            return
        signals = plate.read_signals(message.payload, time.monotonic())
        if signals is None or not plate.skin:
            return
        skin = plate.skin
        if plate.name not in self._reporters:
            self._reporters[plate.name] = SurfaceMessages(
                skin.site_ids,
                skin.skin.site_positions_m,
                skin.grid.pitch_m if skin.grid else None,
                self._decoder_id,
                uncertainty=self._decoding.uncertainty,
            )
        origin = _Origin(signals, self._reporters[plate.name])
        self._stage.offer(
            plate.name, origin, skin, signals.signals.astype(np.float64), signals.noise_std.astype(np.float64)
        )

    def _announce(self, note: Reason | None) -> None:
        self._note = note

    def _refuse(self, name: str, reason: Reason) -> None:
        self._plates[name].refuse(reason)

    def _deliver(self, name: str, origin: _Origin, surface: SurfaceReading) -> None:
        self._plates[name].decoded += 1
        self.latency.add(self._plates[name].age_s(origin.signals))
        header = header_of(origin.signals)
        self._publish(name, DECODED, origin.reporter.decoded(header, surface.decoded))
        self._publish(name, DECODED_SUMMARY, origin.reporter.summary(header, surface, numbered=False))
        self._publish(name, CONTACTS, origin.reporter.contacts(header, surface, numbered=False))
