"""One plate, followed frame after frame by one decoder: the surface, its contacts and their events."""

import asyncio
import time
from collections.abc import Sequence

import numpy as np

from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.skin import Wanted
from resonator_daemon.decoding.skin_decoder import SkinDecoder, SurfaceReading
from resonator_daemon.decoding.stage import DecodingStage
from resonator_daemon.monitoring.latency import LatencyHistogram
from resonator_daemon.publishing.mqtt_messages import Incoming
from resonator_daemon.publishing.payloads import Condition, DecoderPlateHealth, Signals
from resonator_daemon.publishing.publisher import Subscription
from resonator_daemon.publishing.topics import (
    CONTACT_EVENT,
    CONTACTS,
    DECODED,
    DECODED_SUMMARY,
    INFO,
    SIGNALS,
    full_topic,
)
from resonator_daemon.remote_decoding.mode import WAITS_AFTER_S, Publish
from resonator_daemon.remote_decoding.plate import RemotePlate, SkinPlate, header_of
from resonator_daemon.reporting.silence import CONTACTS_END_S
from resonator_daemon.reporting.surface_reports import SurfaceReporter

_LOOK_S = 0.1


class FollowedPlate:
    """Decodes the newest signals of a plate as the daemon would; skips what it has no time for.

    Parameters
    ----------
    prefix
        Of the topics.
    name
        Of the plate.
    wanted
    decoder_id
    publish
    uncertainty
        Whether `decoded` has the traction's standard deviation.
    """

    def __init__(
        self, prefix: str, name: str, wanted: Wanted, decoder_id: str, publish: Publish, *, uncertainty: bool = True
    ) -> None:
        self._plate = RemotePlate(name)
        self._prefix = prefix
        self._wanted = wanted
        self._decoder_id = decoder_id
        self._publish = publish
        self._uncertainty = uncertainty
        self._stage: DecodingStage[Signals] | None = None
        self._changed = asyncio.Event()
        self._note = ""
        self._stage_has_ended = False  # what it announced last is why
        self._is_set_up = False  # the decoder of the stage
        self._delivered: Signals | None = None
        self._decoded = self._skipped = self._events = 0
        self._since_utc_ns: dict[int, int] = {}
        self.latency = LatencyHistogram()
        self.topic_filter = full_topic(prefix, name, SIGNALS.path)

    @property
    def subscriptions(self) -> Sequence[Subscription]:
        info = full_topic(self._prefix, self._plate.name, INFO.path)
        return (Subscription(info, INFO.qos, self._take_info), Subscription(self.topic_filter, 0, self._take_signals))

    def condition(self) -> tuple[Condition, str]:
        name = self._plate.name
        if self._plate.problem:
            return Condition.WAITING, f"{name}: {self._plate.problem}"
        if self._note:
            return (Condition.REFUSED if self._stage_has_ended else Condition.STARTING), f"{name}: {self._note}"
        is_set_up = self._is_set_up and not self._changed.is_set()
        if not is_set_up or time.monotonic() - self._plate.last_s > WAITS_AFTER_S:
            return Condition.WAITING, f"{name}: no signals that could be decoded"
        return Condition.ONLINE, f"signals of {name} are decoded"

    def health(self) -> dict[str, DecoderPlateHealth]:
        plate, stage = self._plate, self._stage
        deaf = stage.frames_without_noise if stage else 0
        account = DecoderPlateHealth(
            received=plate.received,
            decoded=self._decoded,
            skipped=self._skipped + (stage.frames_skipped - deaf if stage else 0),
            unusable=plate.unusable + deaf,
            waiting=stage.waiting if stage else 0,
            missed=plate.missed,
        )
        return {plate.name: account}

    async def run(self) -> None:
        """Decode until cancelled; another `info` begins anew with another stage."""
        looking = asyncio.create_task(self._end_contacts_in_silence(), name="silence")
        try:
            before: SkinDecoder | None = None
            while True:
                self._changed.clear()
                if self._plate.skin is None:
                    await self._changed.wait()
                else:
                    before = await self._decode(self._plate.skin, before)
        finally:
            looking.cancel()

    async def _decode(self, skin: SkinPlate, before: SkinDecoder | None) -> SkinDecoder | None:
        """Decode until the plate has changed; return the decoder that followed contacts last."""
        reporter = SurfaceReporter(
            skin.site_ids,
            skin.skin.site_positions_m,
            skin.grid,
            self._decoder_id,
            uncertainty=self._uncertainty,
            since_utc_ns=self._since_utc_ns,
        )

        stage = self._stage = DecodingStage[Signals](
            skin.skin,
            self._wanted,
            lambda origin, decoded: self._deliver_map(reporter, origin, decoded),
            lambda origin, surface: self._deliver(reporter, origin, surface),
            self._announce,
            before,
        )
        self._note, self._stage_has_ended, self._is_set_up = "", False, False
        running = asyncio.create_task(stage.run(), name="decoding")
        changed = asyncio.create_task(self._changed.wait())
        try:
            await asyncio.wait((running, changed), return_when=asyncio.FIRST_COMPLETED)
            if running.done():
                running.result()
                self._stage_has_ended = True
                await changed
        finally:
            changed.cancel()
            running.cancel()
            await asyncio.wait((running, changed))
            self._skipped += stage.frames_skipped - stage.frames_without_noise + stage.waiting
            self._plate.unusable += stage.frames_without_noise
            self._stage = None
        return stage.latest

    def _take_info(self, message: Incoming) -> None:
        if self._plate.take_info(message.payload):
            self._changed.set()

    def _take_signals(self, message: Incoming) -> None:
        signals = self._plate.take_signals(message.payload, time.monotonic())
        if signals is None:
            return
        if self._stage is None or self._changed.is_set():
            self._skipped += 1
            return
        self._stage.offer(signals, signals.signals.astype(np.float64), signals.noise_std.astype(np.float64))

    def _announce(self, note: str) -> None:
        self._note = note
        self._is_set_up = not note

    def _deliver_map(self, reporter: SurfaceReporter, origin: Signals, decoded: Decoded) -> None:
        self._decoded += 1
        self.latency.add(self._plate.age_s(origin))
        self._publish(self._plate.name, DECODED, reporter.decoded(header_of(origin), decoded))

    def _deliver(self, reporter: SurfaceReporter, origin: Signals, surface: SurfaceReading) -> None:
        name, header = self._plate.name, header_of(origin)
        for event in surface.events:
            self._events += 1
            own = header.copy()
            own["seq"] = self._events - 1
            self._publish(name, CONTACT_EVENT, reporter.event(own, event))
        if origin is not self._delivered:  # else it was decoded before: contacts have ended without a frame
            self._delivered = origin
            self._publish(name, DECODED_SUMMARY, reporter.summary(header, surface))
        self._publish(name, CONTACTS, reporter.contacts(header, surface))

    async def _end_contacts_in_silence(self) -> None:
        ended_s = -np.inf
        while True:
            await asyncio.sleep(_LOOK_S)
            last_s = self._plate.last_s
            if self._stage is not None and last_s > ended_s and time.monotonic() - last_s > CONTACTS_END_S:
                ended_s = last_s
                self._stage.interrupt(f"no signals for {CONTACTS_END_S:g} s")
