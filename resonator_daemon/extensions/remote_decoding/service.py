"""The decoder process as it runs: signals from the broker, surfaces to it."""

import asyncio
import gc
import logging
import os
import re
import secrets
import socket
import sys
import time
from functools import partial
from pathlib import Path
from typing import Final
from urllib.parse import quote

from resonator_daemon.base.errors import ExitCode, UserError
from resonator_daemon.base.host.files import state_directory
from resonator_daemon.base.host.load import ProcessUsage
from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.base.host.systemd import ServiceManager
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.board.config.tables import DECODER
from resonator_daemon.daemon.monitoring.liveness import LivenessMonitor
from resonator_daemon.extensions.remote_decoding.plate import LOOK_S, RemotePlate
from resonator_daemon.measure.sensors.output import LatencyHistogram
from resonator_daemon.mqtt.codec import Encoded, Outgoing, encode
from resonator_daemon.mqtt.payloads import Condition, DecoderHealth, DecoderState
from resonator_daemon.mqtt.publisher import FRESH_S, Publisher
from resonator_daemon.mqtt.topics import (
    DECODED,
    DECODER_EXPIRY_S,
    DECODER_HEALTH,
    DECODER_STATE,
    MessageT,
    Topic,
    full_topic,
)

log = logging.getLogger(__name__)

_SWITCH_S = 5e-4  # of a thread that decodes, before the event loop has its turn; Python's 5 ms are half a frame
_HEALTH_S = 1.0
STATE_AGAIN_S = DECODER_EXPIRY_S / 3  # with MQTT 5 a retained state expires
_LAST_FRAME_S = 0.1  # to end a frame that is being decoded; a set-up takes longer, and nobody waits for it
_HOST_LENGTH_MAX: Final = 80
_NAMED_MAX: Final = 4  # plates in the reason of a state


# The condition of the process is the first of these that a plate has.
_CONDITIONS: Final = (Condition.ONLINE, Condition.STARTING, Condition.WAITING, Condition.REFUSED)


class CannotShareError(UserError):
    """The broker does not deliver each frame to one of many decoders."""

    exit_code = ExitCode.UNAVAILABLE
    code = "cannot_share"


async def serve(config: DecoderConfig) -> None:
    """Decode until SIGINT, SIGTERM or SIGHUP.

    Raises
    ------
    CannotShareError
    """
    process = DecoderProcess(config)
    sys.setswitchinterval(_SWITCH_S)
    with on_signals(lambda _: process.stop()):
        await process.run()


def own_id() -> str:
    """Return an identifier that no other process, past or future, has: host, process id, and a random number.

    Process ids come again, in a container with each start.
    """
    host = re.sub(r"[^A-Za-z0-9._-]", "-", socket.gethostname())[:_HOST_LENGTH_MAX].lstrip("$")
    return f"{host or 'host'}-{os.getpid()}-{secrets.token_hex(3)}"


class DecoderProcess:
    """One decoder between its signals and what it publishes of them.

    Parameters
    ----------
    config
    decoder_id
        One level of a topic, unique on the broker.
    """

    def __init__(self, config: DecoderConfig, decoder_id: str | None = None) -> None:
        self._config = config
        self.decoder_id = decoder_id or own_id()
        self._base = full_topic(config.mqtt.prefix, DECODER, self.decoder_id)
        self._latency = LatencyHistogram()
        self._plates = {
            name: RemotePlate(config, name, self.decoder_id, partial(self._publish, name), self._latency)
            for name in config.plates
        }
        self._topic_filter = " ".join(plate.topic_filter for plate in self._plates.values())
        self._publisher = Publisher(
            config.mqtt,
            identifier=f"resonatord-decoder-{self.decoder_id}-{secrets.token_hex(4)}",
            make_will=self._make_will,
            subscriptions=tuple(each for plate in self._plates.values() for each in plate.subscriptions),
            spool_directory=self._spool_directory(),
            on_connected=self._check_broker,
            stream_wait_max_s=FRESH_S,
        )
        self._manager = ServiceManager()
        self._liveness = LivenessMonitor()
        self._ending = asyncio.Event()
        self._fatal: CannotShareError | None = None
        self._state = (Condition.STARTING, Reason(ReasonCode.STARTED, "started"))
        self._since_utc_ns = time.time_ns()
        self._started_s = self._published_s = time.monotonic()
        self._process = ProcessUsage()

    async def run(self) -> None:
        """Run until `stop`, or raise CannotShareError."""
        gc.freeze()  # what was imported stays: a look through all of it would cost tens of milliseconds
        log.info("decoder %s takes %s", self.decoder_id, self._topic_filter)
        self._publish_state(*self._state)
        async with asyncio.TaskGroup() as tasks:
            helpers = (
                *(tasks.create_task(plate.run(), name="decoding") for plate in self._plates.values()),
                tasks.create_task(self._watch(), name="watch"),
                tasks.create_task(self._report_health(), name="health"),
            )
            tasks.create_task(self._publisher.run(), name="publishing")
            await self._ending.wait()
            self._manager.stopping()
            for helper in helpers:
                helper.cancel()
            await asyncio.wait(helpers, timeout=_LAST_FRAME_S)
            self._publish_health()  # the last counters
            reason = Reason(ReasonCode.STOPPED, "stopped")
            if self._fatal is not None:
                reason = Reason(ReasonCode.CANNOT_SHARE, str(self._fatal))
            offline = self._make_state(Condition.OFFLINE, reason, self._since_utc_ns)
            await self._publisher.close((self._base, DECODER_STATE, offline))  # after the releases of contacts
        if self._fatal is not None:
            raise self._fatal

    def stop(self) -> None:
        """End `run`; from the event loop."""
        self._ending.set()

    def health(self) -> DecoderHealth:
        """Return the counters and loads of this process."""
        use = self._process.measure()
        children = [child for plate in self._plates.values() if (child := plate.process_info()) is not None]
        return DecoderHealth(
            decoder_id=self.decoder_id,
            t_ns=time.time_ns(),
            uptime_s=time.monotonic() - self._started_s,
            plates={name: plate.health() for name, plate in self._plates.items()},
            cpu_percent=use.cpu_percent + sum(child.cpu_percent for child in children),
            rss_mb=use.rss_mb + sum(child.rss_mb for child in children),
            latency={DECODED.path: self._latency.info()},
            messages=self._publisher.account,
        )

    def _spool_directory(self) -> Path | None:
        """Return where events wait, by the first plate; a group has none."""
        if self._config.decoding.group is not None:
            return None
        prefix = quote(self._config.mqtt.prefix, safe="")
        return state_directory() / "spool" / prefix / DECODER / self._config.plates[0]

    def _publish(self, plate: str, topic: Topic[MessageT], message: MessageT | Encoded) -> None:
        self._publisher.publish(f"{self._config.mqtt.prefix}/{plate}", topic, message)

    def _check_broker(self, _connection: int) -> None:
        if self._config.decoding.group is not None and self._publisher.protocol != "5":
            broker = self._config.mqtt
            self._fatal = CannotShareError(
                f"broker {broker.host}:{broker.port} supports MQTT 3.1.1 only, which has no shared subscriptions; "
                "use a broker of MQTT 5, or leave out decoding.group"
            )
            self._ending.set()

    def _condition(self) -> tuple[Condition, Reason]:
        """Return the best condition among the plates, and the reasons of the others."""
        found = {name: plate.condition() for name, plate in self._plates.items()}
        if len(found) == 1:
            return next(iter(found.values()))
        best = min((condition for condition, _ in found.values()), key=_CONDITIONS.index)
        code = next(reason.code for condition, reason in found.values() if condition is best)
        texts = [f"{name}: {reason.text}" for name, (_, reason) in found.items()]
        if len(texts) > _NAMED_MAX:
            texts[_NAMED_MAX:] = [f"and {len(texts) - _NAMED_MAX} more"]
        return best, Reason(code, "; ".join(texts))

    async def _watch(self) -> None:
        self._manager.ready(self._sentence())  # whatever it waits for may come later
        turns = 0
        while True:
            await asyncio.sleep(LOOK_S)
            turns += 1
            state = condition, _ = self._condition()
            decoded = sum(plate.health().decoded for plate in self._plates.values())
            online = condition is Condition.ONLINE
            if self._liveness.healthy(decoded, Condition.ONLINE if online else Condition.WAITING, turns):
                self._manager.alive()
            self._manager.status(self._sentence())
            if state != self._state:
                if state[0] != self._state[0]:
                    self._since_utc_ns = time.time_ns()
                self._state = state
                well = condition in (Condition.ONLINE, Condition.STARTING)
                log.log(logging.INFO if well else logging.WARNING, "%s: %s", condition, state[1].text)
                self._publish_state(*state)
            elif time.monotonic() - self._published_s > STATE_AGAIN_S:
                self._publish_state(*state)

    def _sentence(self) -> str:
        """Return the status line."""
        condition, reason = self._state
        return f"{condition}: {reason.text}" + ("" if self._publisher.connected else "; no broker")

    def _publish_state(self, condition: Condition, reason: Reason) -> None:
        self._published_s = time.monotonic()
        self._publisher.publish(self._base, DECODER_STATE, self._make_state(condition, reason, self._since_utc_ns))

    def _make_state(self, condition: Condition, reason: Reason, since_utc_ns: int | None) -> DecoderState:
        return DecoderState(
            decoder_id=self.decoder_id,
            state=condition,
            reason_code=reason.code,
            reason=reason.text,
            t_ns=time.time_ns(),
            since_t_ns=since_utc_ns,
            topic_filter=self._topic_filter,
        )

    def _make_will(self) -> Outgoing:
        will = self._make_state(Condition.OFFLINE, Reason(ReasonCode.CONNECTION_LOST, "connection lost"), None)
        return Outgoing(
            f"{self._base}/{DECODER_STATE.path}", encode(will), retained=True, expiry_s=DECODER_STATE.expiry_s
        )

    async def _report_health(self) -> None:
        while True:
            await asyncio.sleep(_HEALTH_S)
            self._publish_health()

    def _publish_health(self) -> None:
        self._publisher.publish(self._base, DECODER_HEALTH, self.health())
