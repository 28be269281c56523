"""Many plates whose frames many decoders share: a broker hands each frame to one of them."""

import logging
import time
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from resonator_daemon.config import plate_name
from resonator_daemon.config.decoder import DecoderConfig
from resonator_daemon.decoding.skin import DecodingOptions
from resonator_daemon.decoding.skin_decoder import SurfaceReading
from resonator_daemon.monitoring.latency import LatencyHistogram
from resonator_daemon.publishing.mqtt_messages import Incoming
from resonator_daemon.publishing.payloads import Condition, DecoderPlateHealth, DecoderProcessInfo, Signals
from resonator_daemon.publishing.publisher import Subscription
from resonator_daemon.publishing.topics import (
    CONTACTS,
    DECODED,
    DECODED_SUMMARY,
    INFO,
    SIGNALS,
    full_topic,
    split_topic,
)
from resonator_daemon.reasons import Reason, ReasonCode
from resonator_daemon.remote_decoding.plate import NO_SIGNALS, WAITS_AFTER_S, Publish, RemotePlate, header_of
from resonator_daemon.remote_decoding.shared_stage import SharedStage
from resonator_daemon.sensors.surface_messages import SurfaceMessages

PLATES_MAX: Final = 1000
PROBLEMS_MAX: Final = 100  # of plates that are not in the table
NAME_LENGTH_MAX: Final = 100
GIVES_WAY_AFTER_S: Final = 60.0

_PROBLEMS_NAMED = 3  # in the reason of a state

log = logging.getLogger(__name__)


class _Origin(NamedTuple):
    signals: Signals
    reporter: SurfaceMessages


class SharedPlates:
    """Decodes each frame that the broker hands to this process on its own: no contacts, no events.

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
        self._entered_s: dict[str, float] = {}
        self._problems: dict[str, str] = {}  # of plates that are not entered, the oldest first
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
        return {
            name: plate.health(
                waiting=self._stage.waiting(name),
                skipped=self._stage.skipped[name],
                unusable=self._stage.unusable[name],
            )
            for name, plate in self._plates.items()
        }

    def process_info(self) -> DecoderProcessInfo | None:
        """Return None: frames are decoded in this process."""
        return None

    async def run(self) -> None:
        await self._stage.run()

    def _filter(self, name: str, path: str) -> str:
        return f"$share/{self._decoding.group}/{full_topic(self._prefix, name, path)}"

    def _name(self, message: Incoming) -> str | None:
        """Return whose message it is; None where no plate can be called so."""
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
            self._remember(name, plate.problem.text if plate.problem else "")
        elif self._has_room(name):
            self._plates[name], self._entered_s[name] = plate, time.monotonic()
        else:
            self._remember(name, f"is beyond {PLATES_MAX} plates; name the plates of each group in decoding.plates")

    def _has_room(self, name: str) -> bool:
        """Whether one more plate can be entered; the one silent the longest gives way."""
        if len(self._plates) < PLATES_MAX:
            self._is_full = False
            return True
        silent_s, silent = min(
            (max(plate.last_s, self._entered_s[known]), known) for known, plate in self._plates.items()
        )
        if time.monotonic() - silent_s > GIVES_WAY_AFTER_S:
            self._remove(silent)
            return True
        if not self._is_full:
            log.warning("more than %d plates: %s and others are not decoded", PLATES_MAX, name)
        self._is_full = True
        return False

    def _remember(self, name: str, problem: str) -> None:
        if len(self._problems) >= PROBLEMS_MAX:
            del self._problems[next(iter(self._problems))]
        self._problems[name] = problem

    def _remove(self, name: str) -> None:
        if self._plates.pop(name, None) is None:
            return
        del self._entered_s[name]
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
