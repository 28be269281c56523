"""Plates whose signals one process decodes: subscriptions, counters, state and what is published of them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any, Final, Generic, Protocol, TypeVar

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.estimate.surface.skin import DecodingOptions
from resonator_daemon.extensions.remote_decoding.plate import NO_SIGNALS, RemotePlate
from resonator_daemon.measure.sensors.output import LatencyHistogram
from resonator_daemon.measure.sensors.surface_worker import SurfaceSettings
from resonator_daemon.mqtt.codec import Encoded, Incoming
from resonator_daemon.mqtt.payloads import Condition, DecoderPlateHealth, DecoderProcessInfo, Message, Signals
from resonator_daemon.mqtt.publisher import Subscription
from resonator_daemon.mqtt.topics import DECODED, INFO, SIGNALS, MessageT, Topic, full_topic, split_topic

_NAMED_MAX: Final = 3  # plates in the reason of a state
# The condition of the process is the first of these that a plate has.
_CONDITIONS: Final = (Condition.ONLINE, Condition.STARTING, Condition.WAITING, Condition.REFUSED)

PlateT = TypeVar("PlateT", bound=RemotePlate)


class Publish(Protocol):
    """Publishes a message below the topics of a plate; never waits."""

    def __call__(self, plate: str, topic: Topic[MessageT], message: MessageT | Encoded) -> None: ...


class RemotePlates(ABC, Generic[PlateT]):
    """Decoder of one or more plates on the network.

    Parameters
    ----------
    config
        With the names of the plates.
    decoder_id
        Id of this process, in each result.
    publish
        Called with the plate's name, a topic and a message.

    Attributes
    ----------
    plates
        By name.
    topic_filter
        Topics of the signals, separated by spaces.
    subscriptions
    latency
        Histogram of the age of `decoded` when it is published.
    """

    def __init__(self, config: DecoderConfig, decoder_id: str, publish: Publish) -> None:
        decoding = config.decoding
        self.names = decoding.plates or ((config.name,) if config.name is not None else ())
        if not self.names:
            raise ValueError("the configuration names neither a plate nor a group; see DecoderConfig")
        self._options = DecodingOptions(
            config.method,
            decoding.contact_physics,
            decoding.friction_coefficient,
            decoding.displacement,
            background=not decoding.plates,
        )
        self.make_settings = partial(
            SurfaceSettings, options=self._options, decoder_id=decoder_id, uncertainty=decoding.uncertainty
        )
        self._prefix = config.mqtt.prefix
        self._publish = publish
        share = f"$share/{decoding.group}/" if decoding.group else ""
        signals = [share + full_topic(self._prefix, name, SIGNALS.path) for name in self.names]
        infos = [full_topic(self._prefix, name, INFO.path) for name in self.names]
        self.subscriptions: Sequence[Subscription] = (
            *(Subscription(topic_filter, INFO.qos, self._receive_info) for topic_filter in infos),
            *(Subscription(topic_filter, 0, self._receive_signals) for topic_filter in signals),
        )
        self.topic_filter = " ".join(signals)
        self.plates: dict[str, PlateT] = {}
        self.latency = LatencyHistogram()

    @abstractmethod
    async def run(self) -> None:
        """Decode until cancelled."""

    @abstractmethod
    def _receive_info(self, message: Incoming) -> None:
        """Handle the `info` of a plate."""

    @abstractmethod
    def _offer(self, plate: PlateT, signals: Signals) -> None:
        """Decode usable signals, or skip them; never waits."""

    def process_info(self) -> DecoderProcessInfo | None:
        """Return the counters of the child process that decodes; None while there is none."""
        return None

    def health(self) -> dict[str, DecoderPlateHealth]:
        """Return the counters of each plate's signals."""
        return {name: plate.health() for name, plate in self.plates.items()}

    def condition(self) -> tuple[Condition, Reason]:
        """Return the best condition among the plates, and the reasons of those that are not decoded."""
        found = self._conditions()
        online = [name for name, (condition, _) in found.items() if condition is Condition.ONLINE]
        others = [(name, why) for name, (condition, why) in found.items() if condition is not Condition.ONLINE]
        texts = [f"{name}: {why.text}" for name, why in sorted(others, key=lambda other: other[1] is NO_SIGNALS)]
        if len(texts) > _NAMED_MAX:
            texts[_NAMED_MAX:] = [f"and {len(texts) - _NAMED_MAX} more"]
        if online:
            which = ", ".join(online) if len(online) <= _NAMED_MAX else f"{len(online)} plates"
            texts.insert(0, f"signals of {which} are decoded")
        if not texts:
            return Condition.WAITING, NO_SIGNALS
        first = min((condition for condition, _ in found.values()), key=_CONDITIONS.index)
        code = ReasonCode.DECODING if online else next(why.code for state, why in found.values() if state is first)
        return first, Reason(code, "; ".join(texts))

    def _conditions(self) -> dict[str, tuple[Condition, Reason]]:
        return {name: plate.condition() for name, plate in self.plates.items()}

    def deliver(self, plate: PlateT, signals: Signals, topic: Topic[Any], message: Message | Encoded) -> None:
        """Publish a message about decoded signals."""
        if topic is DECODED:
            plate.decoded += 1
            self.latency.add(plate.age_s(signals))
        self._publish(plate.name, topic, message)

    def _name(self, message: Incoming) -> str:
        """Return the name in the topic of a message."""
        return split_topic(self._prefix, message.topic)[0]

    def _receive_signals(self, message: Incoming) -> None:
        plate = self.plates.get(self._name(message))
        if plate is not None and (signals := plate.read_signals(message.payload)) is not None:
            self._offer(plate, signals)
