"""Several plates that one thread follows frame after frame; equal skins share their matrices."""

import asyncio
from collections.abc import Sequence
from functools import partial
from typing import Final

from threadpoolctl import threadpool_limits

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.daemon.remote_decoding.followed_plate import FollowedPlate
from resonator_daemon.daemon.remote_decoding.plate import Publish
from resonator_daemon.daemon.remote_decoding.thread_decoding import DecodingThread, ThreadDecoding
from resonator_daemon.estimate.surface.skin import DecodingOptions
from resonator_daemon.measure.latency import LatencyHistogram
from resonator_daemon.mqtt.payloads import Condition, DecoderPlateHealth, DecoderProcessInfo, Signals
from resonator_daemon.mqtt.publisher import Subscription

_NAMED_MAX: Final = 3  # plates that are not decoded, in the reason of a state
# The condition of the process is the first of these that a plate has.
_CONDITIONS: Final = (Condition.ONLINE, Condition.STARTING, Condition.WAITING, Condition.REFUSED)


class FollowedPlates:
    """Decoder of several plates, each as `FollowedPlate` decodes one.

    Parameters
    ----------
    config
        With the names of the plates.
    options
        Options of the decoders, without background: the decoding thread also prepares matrices.
    decoder_id, publish
        As of `FollowedPlate`.
    """

    def __init__(self, config: DecoderConfig, options: DecodingOptions, decoder_id: str, publish: Publish) -> None:
        self._thread = DecodingThread()
        self.latency = LatencyHistogram()
        self._plates = [
            FollowedPlate(
                config.model_copy(update={"name": name}),
                options,
                decoder_id,
                publish,
                partial(ThreadDecoding[Signals], thread=self._thread),
                self.latency,
            )
            for name in config.decoding.plates
        ]
        self.topic_filter = " ".join(plate.topic_filter for plate in self._plates)

    @property
    def subscriptions(self) -> Sequence[Subscription]:
        return [subscription for plate in self._plates for subscription in plate.subscriptions]

    def condition(self) -> tuple[Condition, Reason]:
        """Return the best condition among the plates, and the reasons of those that are not decoded."""
        found = [plate.condition() for plate in self._plates]
        online = sum(condition is Condition.ONLINE for condition, _ in found)
        others = [reason for condition, reason in found if condition is not Condition.ONLINE]
        texts = [reason.text for reason in others[:_NAMED_MAX]]
        if len(others) > _NAMED_MAX:
            texts.append(f"and {len(others) - _NAMED_MAX} more")
        if online:
            texts.insert(0, f"signals of {online} plates are decoded")
        first = min((condition for condition, _ in found), key=_CONDITIONS.index)
        code = ReasonCode.DECODING if online else next(reason.code for state, reason in found if state is first)
        return first, Reason(code, "; ".join(texts))

    def health(self) -> dict[str, DecoderPlateHealth]:
        """Return the counters of each plate's signals."""
        return {name: health for plate in self._plates for name, health in plate.health().items()}

    def process_info(self) -> DecoderProcessInfo | None:
        """Return None: this process has no child that decodes."""
        return None

    async def run(self) -> None:
        """Decode until cancelled."""
        with threadpool_limits(1, user_api="blas"):  # as in the daemon's decoder
            try:
                async with asyncio.TaskGroup() as tasks:
                    for plate in self._plates:
                        tasks.create_task(plate.run())
            finally:
                await self._thread.end()
