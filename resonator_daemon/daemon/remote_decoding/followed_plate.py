"""One plate, followed frame after frame by one decoder: the surface, its contacts and their events."""

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.daemon.remote_decoding.plate import (
    NO_SIGNALS,
    WAITS_AFTER_S,
    Publish,
    RemotePlate,
    SkinPlate,
    header_of,
)
from resonator_daemon.daemon.remote_decoding.thread_decoding import ThreadDecoding
from resonator_daemon.estimate.surface.skin import DecodingOptions
from resonator_daemon.measure.decoder_process.supervisor import DecoderSupervisor
from resonator_daemon.measure.latency import LatencyHistogram
from resonator_daemon.measure.pipeline.frame_timeout import CONTACTS_END_S
from resonator_daemon.measure.sensors.surface_decoding import SurfaceClient
from resonator_daemon.measure.sensors.surface_worker import SurfaceFrame, SurfaceSettings
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.headers import MeasuredFields
from resonator_daemon.mqtt.mqtt_messages import Incoming
from resonator_daemon.mqtt.payloads import (
    Condition,
    ContactEvent,
    DecoderPlateHealth,
    DecoderProcessInfo,
    Lost,
    Message,
    Signals,
)
from resonator_daemon.mqtt.publisher import Subscription
from resonator_daemon.mqtt.topics import CONTACT_EVENT, DECODED, INFO, SIGNALS, Topic, full_topic

LOOK_S = 0.1

Decoding = DecoderSupervisor[Signals] | ThreadDecoding[Signals]
MakeDecoding = Callable[[SurfaceSettings, SurfaceClient[Signals], str], Decoding]


class FollowedPlate:
    """Decoder of one plate, with the results of a daemon that decodes itself; skips frames that it has no time for.

    Parameters
    ----------
    config
        With the name of the plate.
    options
        Options of the decoder.
    decoder_id
        Id of this process, in each result.
    publish
        Called with the plate's name, a topic and a message.
    make_decoding
        Called with the plate's name, the settings and this client; by default, a child process decodes.
    latency
        Histogram to add to; by default one for this plate alone.

    Attributes
    ----------
    topic_filter
        Topic of the signals.
    latency
        Histogram of the age of `decoded` when it is published.
    """

    def __init__(
        self,
        config: DecoderConfig,
        options: DecodingOptions,
        decoder_id: str,
        publish: Publish,
        make_decoding: MakeDecoding = DecoderSupervisor[Signals],
        latency: LatencyHistogram | None = None,
    ) -> None:
        if config.name is None:
            raise ValueError("the configuration names neither a plate nor a group; see DecoderConfig")
        self._plate = RemotePlate(config.name)
        self._config = config
        self._options = options
        self._decoder_id = decoder_id
        self._publish = publish
        self._make_decoding = make_decoding
        self._decoder: Decoding | None = None
        self._changed = asyncio.Event()
        self._note: Reason | None = None
        self._decoder_has_ended = False  # the reason is its last announcement
        self._is_set_up = False  # the decoder
        self._events = 0
        self.latency = latency or LatencyHistogram()
        self.topic_filter = full_topic(config.mqtt.prefix, config.name, SIGNALS.path)

    @property
    def subscriptions(self) -> Sequence[Subscription]:
        info = full_topic(self._config.mqtt.prefix, self._plate.name, INFO.path)
        return (
            Subscription(info, INFO.qos, self._receive_info),
            Subscription(self.topic_filter, 0, self._receive_signals),
        )

    def condition(self) -> tuple[Condition, Reason]:
        """Return the present state and its reason."""
        name = self._plate.name
        if self._plate.problem:
            return Condition.WAITING, _of(name, self._plate.problem)
        if self._note:
            return (Condition.REFUSED if self._decoder_has_ended else Condition.STARTING), _of(name, self._note)
        is_set_up = self._is_set_up and not self._changed.is_set()
        if not is_set_up or time.monotonic() - self._plate.last_s > WAITS_AFTER_S:
            return Condition.WAITING, _of(name, NO_SIGNALS)
        return Condition.ONLINE, Reason(ReasonCode.DECODING, f"signals of {name} are decoded")

    def health(self) -> dict[str, DecoderPlateHealth]:
        """Return the counters of the plate's signals."""
        plate, decoder = self._plate, self._decoder
        if decoder is None:
            return {plate.name: plate.health(waiting=0)}
        without_noise = decoder.skipped["no_noise"]
        skipped = decoder.skipped.total() - without_noise
        return {plate.name: plate.health(waiting=decoder.waiting, skipped=skipped, unusable=without_noise)}

    def process_info(self) -> DecoderProcessInfo | None:
        """Return the counters of the decoder process; None while there is none."""
        return self._decoder.info() if isinstance(self._decoder, DecoderSupervisor) else None

    async def run(self) -> None:
        """Decode until cancelled; another `info` starts another decoder."""
        ending = asyncio.create_task(self._end_contacts_without_signals(), name="contacts without signals")
        try:
            last_contact_id = 0
            while True:
                self._changed.clear()
                if not self._plate.skin:
                    await self._changed.wait()
                else:
                    last_contact_id = await self._decode(self._plate.skin, last_contact_id)
        finally:
            ending.cancel()

    async def _decode(self, skin: SkinPlate, last_contact_id: int) -> int:
        """Decode until the plate has changed; return the number of the last contact."""
        settings = SurfaceSettings(
            skin.skin,
            self._options,
            skin.site_ids,
            skin.grid.pitch_m if skin.grid else None,
            decoder_id=self._decoder_id,
            uncertainty=self._config.decoding.uncertainty,
            last_contact_id=last_contact_id,
        )
        decoder = self._decoder = self._make_decoding(settings, self, self._plate.name)
        self._note, self._decoder_has_ended, self._is_set_up = None, False, False
        running = asyncio.create_task(decoder.run(), name="decoding")
        changed = asyncio.create_task(self._changed.wait())
        try:
            await asyncio.wait((running, changed), return_when=asyncio.FIRST_COMPLETED)
            if running.done():
                running.result()
                self._decoder_has_ended = True
                await changed
        finally:
            changed.cancel()
            running.cancel()
            await asyncio.wait((running, changed))
            without_noise = decoder.skipped["no_noise"]
            self._plate.skipped += decoder.skipped.total() - without_noise + decoder.waiting
            self._plate.unusable += without_noise
            self._decoder = None
            stopped = Reason(ReasonCode.STOPPED, "the decoder stopped")
            other_plate = Reason(ReasonCode.PLATE_CHANGED, "the plate has changed")
            decoder.release_contacts(other_plate if self._changed.is_set() else stopped)
        return decoder.last_contact_id

    def _receive_info(self, message: Incoming) -> None:
        if self._plate.read_info(message.payload):
            self._changed.set()

    def _receive_signals(self, message: Incoming) -> None:
        signals = self._plate.read_signals(message.payload, time.monotonic())
        if signals is None:
            return
        if self._decoder is None or self._changed.is_set():
            self._plate.skipped += 1
            return
        header = header_of(signals)
        self._decoder.offer(
            signals,
            SurfaceFrame(
                header, header["seq"], signals.signals.astype(np.float64), signals.noise_std.astype(np.float64)
            ),
        )

    def announce(self, note: Reason | None) -> None:
        """Report what is being set up, or why nothing is decoded."""
        self._note = note
        self._is_set_up = note is None

    def lost(self, origin: Signals) -> Lost:
        """Return the daemon's losses, as the signals state them."""
        return origin.lost

    def contacts_header(self, origin: Signals) -> MeasuredFields:
        """Return the header of one more message on `contacts`."""
        return header_of(origin)

    def deliver(self, origin: Signals, topic: Topic[Any], message: Message | Encoded) -> None:
        """Publish a message about decoded signals."""
        if topic is DECODED:
            self._plate.decoded += 1
            self.latency.add(self._plate.age_s(origin))
        self._publish(self._plate.name, topic, message)

    def deliver_event(self, _origin: Signals, event: ContactEvent) -> None:
        """Publish an event of a contact."""
        self._publish(self._plate.name, CONTACT_EVENT, event.model_copy(update={"seq": self._events}))
        self._events += 1

    async def _end_contacts_without_signals(self) -> None:
        ended_s = -np.inf
        while True:
            await asyncio.sleep(LOOK_S)
            last_s = self._plate.last_s
            if self._decoder is not None and last_s > ended_s and time.monotonic() - last_s > CONTACTS_END_S:
                ended_s = last_s
                self._decoder.interrupt(Reason(ReasonCode.NO_SIGNALS, f"no signals for {CONTACTS_END_S:g} s"))


def _of(plate: str, reason: Reason) -> Reason:
    return Reason(reason.code, f"{plate}: {reason.text}")
