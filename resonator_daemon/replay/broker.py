"""The messages of a replay at a broker, as those of a daemon are, and never together with those of a live one."""

import asyncio
import secrets
import time
from contextlib import aclosing
from typing import Final, Self

from resonator_daemon.config import Mqtt
from resonator_daemon.errors import ExitCode, UserError
from resonator_daemon.host.printable import printable
from resonator_daemon.monitoring.daemon_state import DaemonSnapshot, DaemonState
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.headers import Headers
from resonator_daemon.publishing.message_account import Cause
from resonator_daemon.publishing.mqtt_messages import Outgoing
from resonator_daemon.publishing.payloads import Condition, Lost, State
from resonator_daemon.publishing.publisher import Publisher, Subscription
from resonator_daemon.publishing.requests import BrokerUnreachableError, reach
from resonator_daemon.publishing.subscriber import subscribe
from resonator_daemon.publishing.topics import STATE_DAEMON, TOPICS, full_topic
from resonator_daemon.reasons import Reason, ReasonCode
from resonator_daemon.replay.recorded_pipeline import Published

LOOK_S: Final = 1.0  # for what the broker has retained
CONNECT_S: Final = 10.0
WAITING_MAX: Final = 500  # messages; far below what would be dropped

_TURN_S: Final = 1e-3


class NameTakenError(UserError):
    """A daemon publishes under that name."""

    exit_code = ExitCode.UNAVAILABLE
    code = "name_taken"


class AtBroker:
    """Publishes under a name, as fast as the broker takes it: nothing is dropped while there is a connection.

    Parameters
    ----------
    mqtt
        Broker and prefix.
    name
        To publish under.
    file_name
        Of the recording.

    Attributes
    ----------
    daemon_boot_id
        That the messages are to bear.

    Raises
    ------
    BrokerUnreachableError
        Nobody listens there, or it takes no connection.
    NameTakenError
        A daemon publishes under that name, or its retained state is not `offline`.
    """

    def __init__(self, mqtt: Mqtt, name: str, file_name: str) -> None:
        self._mqtt = mqtt
        self._name = name
        self._what = f"replaying {printable(file_name)}"
        self._base = f"{mqtt.prefix}/{name}"
        self.daemon_boot_id = secrets.token_hex(4)
        self._headers = Headers(name, self.daemon_boot_id, Lost)

    @property
    def dropped(self) -> dict[str, int]:
        """Messages that subscribers miss, by cause, as where the broker went away."""
        dropped = self._publisher.account.dropped
        return {cause: count for cause, count in dropped.items() if cause != Cause.SUPERSEDED}

    async def __aenter__(self) -> Self:
        await reach(self._mqtt)
        await self._refuse_a_taken_name()
        self._state = DaemonState(self.daemon_boot_id, self._publish_state, lambda: self._publisher.restore_now())
        topic = full_topic(self._mqtt.prefix, self._name, STATE_DAEMON.path)
        self._publisher = Publisher(
            self._mqtt,
            identifier=f"resonatord-replay-{self.daemon_boot_id}",
            make_will=self._make_will,
            subscriptions=(Subscription(topic, 1, self._state.receive),),
            on_connected=self._state.connected,
            announce=self._state.announce,
        )
        self._running = asyncio.create_task(self._publisher.run())
        self._state.become(Condition.ONLINE, Reason(ReasonCode.REPLAYING, self._what), time.time_ns())
        try:
            async with asyncio.timeout(CONNECT_S):
                await self._connected()
        except TimeoutError:
            self._running.cancel()
            await asyncio.wait([self._running])
            where = f"{self._mqtt.host}:{self._mqtt.port}"
            raise BrokerUnreachableError(f"the broker at {where} takes no connection; see above for why") from None
        return self

    async def __aexit__(self, _kind: object, error: BaseException | None, _where: object) -> None:
        self._state.end()
        if error is None:
            await self._room(0)
        offline = self._daemon_state(self._offline(Reason(ReasonCode.RECORDING_OVER, f"{self._what}: over")))
        await self._publisher.close((self._base, STATE_DAEMON, offline))
        await self._running

    async def put(self, published: Published) -> None:
        if published.topic.retained:
            await self._room(0)  # a state that waits would give way to this one
        elif not self._publisher.connected or self._publisher.account.waiting > WAITING_MAX:
            await self._room(WAITING_MAX // 2)
        self._publisher.publish(self._base, published.topic, published.message)

    async def _room(self, waiting: int) -> None:
        """Wait for the broker, however long that takes, until no more messages wait than this."""
        await self._connected()
        while self._publisher.account.waiting > waiting:  # noqa: ASYNC110 - the publisher offers no event for it
            await asyncio.sleep(_TURN_S)

    async def _connected(self) -> None:
        while not self._publisher.connected:
            if self._running.done():
                await self._running  # raises why
            await asyncio.sleep(_TURN_S)

    async def _refuse_a_taken_name(self) -> None:
        topics = (TOPICS[STATE_DAEMON.path],)
        try:
            async with asyncio.timeout(LOOK_S), aclosing(subscribe(self._mqtt, topics)) as messages:
                async for name, _, message in messages:
                    if name == self._name and isinstance(message, State) and message.state is not Condition.OFFLINE:
                        reason = printable(message.reason)
                        raise NameTakenError(
                            f"a daemon publishes as {self._base} ({message.state}: {reason}); stop it, or give --name"
                        )
        except TimeoutError:
            pass  # no message of this name came

    def _publish_state(self, snapshot: DaemonSnapshot) -> None:
        self._publisher.publish(self._base, STATE_DAEMON, self._daemon_state(snapshot))

    def _offline(self, reason: Reason) -> DaemonSnapshot:
        return self._state.snapshot._replace(condition=Condition.OFFLINE, reason=reason, since_utc_ns=time.time_ns())

    def _daemon_state(self, snapshot: DaemonSnapshot) -> State:
        return snapshot.message(self._headers.of(STATE_DAEMON, time.time_ns()))

    def _make_will(self) -> Outgoing:
        will = self._daemon_state(self._offline(Reason(ReasonCode.CONNECTION_LOST, "connection lost")))
        will = will.model_copy(update={"since_t_ns": None})
        return Outgoing(f"{self._base}/{STATE_DAEMON.path}", encode(will), retained=STATE_DAEMON.retained)
