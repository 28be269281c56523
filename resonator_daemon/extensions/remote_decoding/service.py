"""The decoder process as it runs: signals from the broker, surfaces to it."""

import asyncio
import gc
import json
import logging
import os
import re
import secrets
import socket
import sys
import time
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from resonator_daemon.base.errors import ExitCode, UserError
from resonator_daemon.base.host.files import state_directory
from resonator_daemon.base.host.load import ProcessUsage
from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.base.host.systemd import ServiceManager
from resonator_daemon.base.reasons import Reason, ReasonCode, joined
from resonator_daemon.board.config.clients import DecoderConfig
from resonator_daemon.board.config.tables import DECODER
from resonator_daemon.daemon.monitoring.liveness import LivenessMonitor
from resonator_daemon.extensions.remote_decoding.followed_plates import FollowedPlates
from resonator_daemon.extensions.remote_decoding.plates import RemotePlates
from resonator_daemon.extensions.remote_decoding.shared_plates import SharedPlates
from resonator_daemon.mqtt.codec import Encoded, Incoming, Outgoing, encode
from resonator_daemon.mqtt.payloads import Condition, DecoderHealth, DecoderState
from resonator_daemon.mqtt.publisher import FRESH_S, Publisher, Subscription
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

LOOK_S = 0.1
_SWITCH_S = 5e-4  # of a thread that decodes, before the event loop has its turn; Python's 5 ms are half a frame
_HEALTH_S = 1.0
STATE_AGAIN_S = DECODER_EXPIRY_S / 3  # with MQTT 5 a retained state expires
_LAST_FRAME_S = 0.1  # to end a frame that is being decoded; a set-up takes longer, and nobody waits for it
_HOST_LENGTH_MAX: Final = 80
_ID_LENGTH_MAX: Final = 120
_NAMED_MAX: Final = 4  # other decoders: any client can publish states of more


class CannotShareError(UserError):
    """The broker hands no frame to one of many."""

    exit_code = ExitCode.UNAVAILABLE
    code = "cannot_share"


async def serve(config: DecoderConfig) -> None:
    """Decode until SIGINT, SIGTERM or SIGHUP.

    Raises
    ------
    UserError
        The broker cannot share plates among decoders.
    """
    process = DecoderProcess(config)
    sys.setswitchinterval(_SWITCH_S)
    with on_signals(lambda _: process.stop()):
        await process.run()


def own_id() -> str:
    """Name this process as no other one, of another time neither: host, process id, and a random number.

    Process ids come again, in a container with each start.
    """
    host = re.sub(r"[^A-Za-z0-9._-]", "-", socket.gethostname())[:_HOST_LENGTH_MAX].lstrip("$")
    return f"{host or 'host'}-{os.getpid()}-{secrets.token_hex(3)}"


class OtherDecoders:
    """Other decoders of the same signals, by their states, which they repeat within `DECODER_EXPIRY_S`.

    A live state adds a decoder, `offline` removes it. Retained states add none: their decoder may have ended, and one
    that runs publishes again when it receives the state of this one.

    Parameters
    ----------
    decoder_id
        Id of this process.
    topic_filter
        Topics of its signals, separated by spaces.
    """

    def __init__(self, decoder_id: str, topic_filter: str) -> None:
        self._decoder_id = decoder_id
        self._topic_filters = set(topic_filter.split())
        self._seen_s: dict[str, float] = {}  # arrival of the last state, by id

    def receive(self, message: Incoming, now_s: float) -> None:
        """Handle the state of any decoder."""
        try:
            content = json.loads(message.payload)
            other, state, taken = content["decoder_id"], content["state"], content["topic_filter"]
        except (ValueError, RecursionError, TypeError, KeyError):
            return
        if not isinstance(other, str) or not other.isprintable() or not 0 < len(other) <= _ID_LENGTH_MAX:
            return
        if state == Condition.OFFLINE or self._topic_filters.isdisjoint(str(taken).split()):
            self._seen_s.pop(other, None)
        elif other in self._seen_s or (
            other != self._decoder_id and not message.retained and len(self._seen_s) < _NAMED_MAX
        ):
            self._seen_s[other] = now_s

    def remark(self, now_s: float) -> Reason | None:
        """Return a reason that lists the other decoders; None without one."""
        self._seen_s = {other: at_s for other, at_s in self._seen_s.items() if now_s - at_s < DECODER_EXPIRY_S}
        if not self._seen_s:
            return None
        others = ", ".join(sorted(self._seen_s))
        what = "this plate" if len(self._topic_filters) == 1 else "some of these plates"
        text = f"decoder {others} follows {what}, too, and both publish: stop one of them"
        return Reason(ReasonCode.SECOND_DECODER, text)


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
        self._group = config.decoding.group
        plates = SharedPlates if self._group else FollowedPlates
        self._plates: RemotePlates[Any] = plates(config, self.decoder_id, self._publish)
        self._others = OtherDecoders(self.decoder_id, self._plates.topic_filter)
        self._publisher = Publisher(
            config.mqtt,
            identifier=f"resonatord-decoder-{self.decoder_id}-{secrets.token_hex(4)}",
            make_will=self._make_will,
            subscriptions=(*self._plates.subscriptions, *self._subscriptions_to_others()),
            spool_directory=self._spool_directory(),
            on_connected=self._connected,
            on_denied=self._denied,
            stream_wait_max_s=FRESH_S,
        )
        self._manager = ServiceManager()
        self._liveness = LivenessMonitor()
        self._fatal: UserError | None = None
        self._ending = asyncio.Event()
        self._state = (Condition.STARTING, Reason(ReasonCode.STARTED, "started"))
        self._since_utc_ns = time.time_ns()
        self._started_s = self._published_s = time.monotonic()
        self._process = ProcessUsage()

    async def run(self) -> None:
        """Run until `stop`; raises UserError."""
        gc.freeze()  # what was imported stays: a look through all of it would cost tens of milliseconds
        log.info("decoder %s takes %s", self.decoder_id, self._plates.topic_filter)
        self._publish_state(*self._state)
        async with asyncio.TaskGroup() as tasks:
            helpers = (
                tasks.create_task(self._plates.run(), name="decoding"),
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
            stopped = Reason(ReasonCode.STOPPED, "stopped")
            reason = Reason(ReasonCode.CANNOT_SHARE, str(self._fatal)) if self._fatal is not None else stopped
            offline = self._make_state(Condition.OFFLINE, reason, self._since_utc_ns)
            await self._publisher.close((self._base, DECODER_STATE, offline))  # after the releases of contacts
        if self._fatal is not None:
            raise self._fatal

    def stop(self) -> None:
        """End `run`; from the event loop."""
        self._ending.set()

    def health(self) -> DecoderHealth:
        """Return the counters and loads of this process."""
        use, child = self._process.measure(), self._plates.process_info()
        return DecoderHealth(
            decoder_id=self.decoder_id,
            t_ns=time.time_ns(),
            uptime_s=time.monotonic() - self._started_s,
            plates=self._plates.health(),
            cpu_percent=use.cpu_percent + (child.cpu_percent if child is not None else 0.0),
            rss_mb=use.rss_mb + (child.rss_mb if child is not None else 0.0),
            latency={DECODED.path: self._plates.latency.info()},
            messages=self._publisher.account,
        )

    def _spool_directory(self) -> Path | None:
        """Return where events of followed plates wait, by the first; there are none where frames are shared."""
        decoding = self._config.decoding
        name = decoding.plates[0] if decoding.plates else self._config.name
        if name is None or self._group:
            return None
        return state_directory() / "spool" / quote(self._config.mqtt.prefix, safe="") / DECODER / name

    def _subscriptions_to_others(self) -> tuple[Subscription, ...]:
        if self._group:  # its decoders share the frames
            return ()
        states = full_topic(self._config.mqtt.prefix, DECODER, f"+/{DECODER_STATE.path}")
        # QoS 0: each state comes again, and no acknowledgement is open when this process ends.
        return (Subscription(states, 0, lambda it: self._others.receive(it, time.monotonic())),)

    def _publish(self, plate: str, topic: Topic[MessageT], message: MessageT | Encoded) -> None:
        self._publisher.publish(f"{self._config.mqtt.prefix}/{plate}", topic, message)

    def _connected(self, _number: int) -> None:
        if self._group is not None and self._publisher.protocol != "5":
            broker = self._config.mqtt
            self._cannot_share(
                f"broker {broker.host}:{broker.port} supports MQTT 3.1.1 only, which has no shared subscriptions"
            )

    def _denied(self, topic_filter: str, reason: str) -> None:
        if reason.lower().startswith("shared subscription"):
            self._cannot_share(f"broker refuses {topic_filter}: {reason}")

    def _cannot_share(self, why: str) -> None:
        self._fatal = CannotShareError(
            f"{why}; use a broker of MQTT 5 with shared subscriptions, or leave out decoding.plates and "
            "decoding.group and run one decoder for each plate, with its name"
        )
        self._ending.set()

    async def _watch(self) -> None:
        self._manager.ready(self._sentence())  # whatever it waits for may come later
        turns = 0
        while True:
            await asyncio.sleep(LOOK_S)
            turns += 1
            condition, reason = self._plates.condition()
            others = self._others.remark(time.monotonic())
            state = condition, joined(reason, others) or reason
            decoded = sum(plate.decoded for plate in self._plates.plates.values())
            online = condition is Condition.ONLINE
            if self._liveness.healthy(decoded, Condition.ONLINE if online else Condition.WAITING, turns):
                self._manager.alive()
            self._manager.status(self._sentence())
            if state != self._state:
                if state[0] != self._state[0]:
                    self._since_utc_ns = time.time_ns()
                self._state = state
                well = condition in (Condition.ONLINE, Condition.STARTING) and not others
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
            topic_filter=self._plates.topic_filter,
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
