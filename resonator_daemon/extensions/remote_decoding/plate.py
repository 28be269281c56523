"""A plate on the network: reads what it publishes, has its signals decoded and publishes the results."""

import asyncio
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, Protocol

import numpy as np

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.estimate.surface.skin import DecodingOptions
from resonator_daemon.extensions.remote_decoding.info import INT64, NO_INFO, UnusableInfoError, read_info
from resonator_daemon.measure.decoder_process.supervisor import DecoderSupervisor
from resonator_daemon.measure.pipeline.board_pipeline import CONTACTS_END_S
from resonator_daemon.measure.sensors.output import LatencyHistogram
from resonator_daemon.measure.sensors.surface_decoding import ERRORS_OF_RESULTS, Skipped
from resonator_daemon.measure.sensors.surface_requests import SurfaceFrame, SurfaceSettings
from resonator_daemon.mqtt.codec import Encoded, Incoming, decode
from resonator_daemon.mqtt.payloads import (
    Condition,
    ContactEvent,
    DecoderPlateHealth,
    DecoderProcessInfo,
    Lost,
    Measured,
    Message,
    Signals,
    Status,
)
from resonator_daemon.mqtt.publisher import Subscription
from resonator_daemon.mqtt.topics import (
    CONTACT_EVENT,
    DECODED,
    DECODED_SUMMARY,
    INFO,
    SIGNALS,
    TOPICS,
    HeaderFields,
    MessageT,
    Topic,
    full_topic,
)

LOOK_S: Final = 0.1
WAITS_AFTER_S: Final = 2.0  # without signals, a decoder is waiting
_NO_SIGNALS: Final = Reason(ReasonCode.NO_SIGNALS, "no signals that could be decoded")
_NS: Final = 1_000_000_000


class Publish(Protocol):
    """Publishes a message below the topics of the plate; never waits."""

    def __call__(self, topic: Topic[MessageT], message: MessageT | Encoded) -> None: ...


class RemotePlate:
    """Decodes the signals of a plate in a child process; unreadable messages are counted, and never raise.

    Parameters
    ----------
    config
    name
        Of the plate.
    decoder_id
        Id of this process, in each result.
    publish
        Called with a topic and a message. In a group, only maps and their summaries are published: no decoder receives
        all frames, so that contacts have no beginning, number or end.
    latency
        Receives the age of each `decoded` when it is published.

    Attributes
    ----------
    topic_filter
        Topic of its signals.
    subscriptions
    settings
        Of a decoder, by the last `info`; None where that is missing, unreadable, or of a plate that cannot be decoded.
    """

    def __init__(
        self, config: DecoderConfig, name: str, decoder_id: str, publish: Publish, latency: LatencyHistogram
    ) -> None:
        decoding = config.decoding
        options = DecodingOptions(
            config.method,
            decoding.contact_physics,
            decoding.friction_coefficient,
            decoding.displacement,
        )
        self._make_settings = partial(
            SurfaceSettings,
            options=options,
            decoder_id=decoder_id,
            uncertainty=decoding.uncertainty,
            numbered=decoding.group is None,
        )
        self._name = name
        self._topics = (DECODED, DECODED_SUMMARY) if decoding.group else (*TOPICS.values(),)
        self._publish = publish
        share = f"$share/{decoding.group}/" if decoding.group else ""
        self.topic_filter = share + full_topic(config.mqtt.prefix, name, SIGNALS.path)
        self.subscriptions: Sequence[Subscription] = (
            Subscription(full_topic(config.mqtt.prefix, name, INFO.path), INFO.qos, self._receive_info),
            Subscription(self.topic_filter, 0, self._receive_signals),
        )
        self.settings: SurfaceSettings | None = None
        self._latency = latency
        self._problem: Reason | None = NO_INFO  # why there are no settings
        self._note: Reason | None = None  # as announced last
        self._is_refused = self._is_decoded = False
        self._gate_s = 0.0  # length of a frame's gate
        self._received = self._unusable = self._missed = self._decoded = self._events = 0
        self._skips: Counter[Skipped] = Counter()  # of all its decoders
        self._last: tuple[str, int] | None = None  # boot of the daemon, seq
        self._last_s = self._contacts_ended_s = -math.inf  # monotonic time of the last usable signals
        self._changed = asyncio.Event()
        self._decoding: DecoderSupervisor[Signals] | None = None

    def health(self) -> DecoderPlateHealth:
        """Return the counters of its signals."""
        without_noise = self._skips["no_noise"]
        return DecoderPlateHealth(
            received=self._received,
            decoded=self._decoded,
            skipped=self._skips.total() - without_noise,
            unusable=self._unusable + without_noise,
            waiting=self._decoding.waiting if self._decoding is not None else 0,
            missed=self._missed,
        )

    def process_info(self) -> DecoderProcessInfo | None:
        """Return the counters of the child process that decodes; None while there is none."""
        return self._decoding.info() if self._decoding is not None else None

    def condition(self) -> tuple[Condition, Reason]:
        """Return the present state and its reason."""
        if self._problem:
            return Condition.WAITING, self._problem
        if self._note and self._note.code not in ERRORS_OF_RESULTS:
            return (Condition.REFUSED if self._is_refused else Condition.STARTING), self._note
        if not self._is_decoded or time.monotonic() - self._last_s > WAITS_AFTER_S:
            return Condition.WAITING, _NO_SIGNALS
        return Condition.ONLINE, self._note or Reason(ReasonCode.DECODING, "signals are decoded")

    async def run(self) -> None:
        """Decode until cancelled; another skin starts another decoder."""
        last_contact_id = 0
        while True:
            self._changed.clear()
            if self.settings is None:
                await self._changed.wait()
            else:
                last_contact_id = await self._decode(replace(self.settings, last_contact_id=last_contact_id))

    async def _decode(self, settings: SurfaceSettings) -> int:
        """Decode until the plate has changed; return the number of the last contact."""
        decoding = self._decoding = DecoderSupervisor(settings, self, self._name)
        decoding.skipped = self._skips
        self._note, self._is_refused = None, False
        running = asyncio.create_task(decoding.run(), name="decoding")
        changed = asyncio.create_task(self._changed.wait())
        try:
            while not changed.done():
                await asyncio.wait((changed,), timeout=LOOK_S)
                if running.done():
                    running.result()
                    self._is_refused = True  # the reason is its last announcement
                self._end_silent_contacts(decoding)
        finally:
            changed.cancel()
            running.cancel()
            await asyncio.wait((running, changed))
            self._decoding = None
            stopped = Reason(ReasonCode.STOPPED, "the decoder stopped")
            other_plate = Reason(ReasonCode.PLATE_CHANGED, "the plate has changed")
            decoding.release_contacts(other_plate if self._changed.is_set() else stopped)
        return decoding.last_contact_id

    def _end_silent_contacts(self, decoding: DecoderSupervisor[Signals]) -> None:
        """Release the contacts if no signals have arrived for some time."""
        if time.monotonic() - self._last_s > CONTACTS_END_S and self._last_s > self._contacts_ended_s:
            self._contacts_ended_s = self._last_s
            decoding.interrupt(Reason(ReasonCode.NO_SIGNALS, f"no signals for {CONTACTS_END_S:g} s"))

    def _receive_info(self, message: Incoming) -> None:
        """Read an `info`, or b"" where it was taken back; start another decoder if the skin is another one."""
        before = self.settings
        try:
            self.settings, self._gate_s = read_info(message.payload, self._make_settings)
        except UnusableInfoError as error:
            self.settings, self._problem = None, error.reason
        else:
            self._problem = None
            if before is not None and _is_same(self.settings, before):
                self.settings = before
        if self.settings is not before:
            self._is_decoded = False
            self._changed.set()

    def _receive_signals(self, message: Incoming) -> None:
        """Decode usable signals as soon as can be; skip those that arrive before there is a decoder."""
        self._received += 1
        signals = self._read_signals(message.payload)
        if signals is None:
            self._unusable += 1
            return
        self._last_s = time.monotonic()
        if self._decoding is None or self._changed.is_set():
            self._skips["not_ready"] += 1
        else:
            self._decoding.offer(signals, frame_of(signals))

    def _read_signals(self, payload: bytes) -> Signals | None:
        """Read a `signals`; None where it cannot be decoded."""
        try:
            message = decode(Signals, payload)
        except (ValueError, RecursionError, MemoryError, OverflowError):
            return None
        numbers = (message.seq, message.t_uncertainty_ns, *message.lost.model_dump().values())
        if not all(number in INT64 for number in numbers):
            return None
        self._count_missed(message)
        if self.settings is None or message.status is not Status.OK:
            return None
        shape = (3, len(self.settings.site_ids))
        return message if message.signals.shape == message.noise_std.shape == shape else None

    def _count_missed(self, message: Signals) -> None:
        """Count the gap in `seq` while the daemon stayed the same."""
        if self._last is not None and self._last[0] == message.daemon_boot_id:
            self._missed += max(message.seq - self._last[1] - 1, 0)
            if message.seq < self._last[1]:
                return
        self._last = message.daemon_boot_id, message.seq

    def announce(self, note: Reason | None) -> None:
        """Report what is being set up, why nothing is decoded, or what is wrong with the results."""
        self._note = note
        self._is_decoded = (note is None or note.code in ERRORS_OF_RESULTS) and not self._changed.is_set()

    def lost(self, origin: Signals) -> Lost:
        """Return the daemon's losses, as the signals state them."""
        return origin.lost

    def contacts_header(self, origin: Signals) -> HeaderFields:
        """Return the header of one more message on `contacts`."""
        return header_of(origin)

    def deliver(self, origin: Signals, topic: Topic[Any], message: Message | Encoded) -> None:
        """Publish a message about decoded signals."""
        if topic is DECODED:
            self._decoded += 1
            # From the end of the frame's gate until now, as far as this computer's clock and its agree.
            self._latency.add((time.time_ns() - origin.t_ns) / _NS - self._gate_s / 2)
        if topic in self._topics:
            self._publish(topic, message)

    def deliver_event(self, origin: Signals, event: ContactEvent) -> None:
        """Publish an event of a contact."""
        self.deliver(origin, CONTACT_EVENT, event.model_copy(update={"seq": self._events}))
        self._events += 1


def header_of(message: Signals) -> HeaderFields:
    """Return the header for what is decoded of these signals: it belongs to the same instant and has the same `seq`."""
    return {key: getattr(message, key) for key in Measured.model_fields}


def frame_of(message: Signals) -> SurfaceFrame:
    """Return the frame for the decoder, from a message of signals."""
    header = header_of(message)
    signals, noise_std = message.signals.astype(np.float64), message.noise_std.astype(np.float64)
    return SurfaceFrame(header, header["seq"], signals, noise_std)


def _is_same(one: SurfaceSettings, other: SurfaceSettings) -> bool:
    return (
        one.skin.geometry() == other.skin.geometry()
        and one.pitch_m == other.pitch_m
        and np.array_equal(one.site_ids, other.site_ids)
    )
