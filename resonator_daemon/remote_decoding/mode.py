"""What the two ways to decode have in common for the process around them."""

from collections.abc import Sequence
from typing import Final, Protocol

from resonator_daemon.config.decoder import DecoderConfig
from resonator_daemon.decoding.skin import DecodingOptions
from resonator_daemon.monitoring.latency import LatencyHistogram
from resonator_daemon.publishing.codec import Encoded
from resonator_daemon.publishing.payloads import Condition, DecoderPlateHealth, DecoderProcessInfo
from resonator_daemon.publishing.publisher import Subscription
from resonator_daemon.publishing.topics import MessageT, Topic

WAITS_AFTER_S: Final = 2.0  # without signals, a decoder says that it waits


class Publish(Protocol):
    """Publishes a message below the topics of a plate; never waits."""

    def __call__(self, plate: str, topic: Topic[MessageT], message: MessageT | Encoded) -> None: ...


class Mode(Protocol):
    """Decoding of subscribed signals, for one plate or many."""

    topic_filter: str  # of the signals
    latency: LatencyHistogram  # of `decoded`

    @property
    def subscriptions(self) -> Sequence[Subscription]: ...

    def condition(self) -> tuple[Condition, str]:
        """Return how it goes now, and why."""

    def health(self) -> dict[str, DecoderPlateHealth]:
        """Account of each plate's signals."""

    def process_info(self) -> DecoderProcessInfo | None:
        """Return the counters of the decoder process; None if frames are decoded in this process."""

    async def run(self) -> None:
        """Decode until cancelled."""


def decoding_options(config: DecoderConfig, *, background: bool) -> DecodingOptions:
    decoding = config.decoding
    return DecodingOptions(
        config.method, decoding.contact_physics, decoding.friction_coefficient, decoding.displacement, background
    )
