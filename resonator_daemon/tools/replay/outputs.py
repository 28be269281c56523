"""Outputs of a replay: lines of a file, or messages at a broker like those of a daemon."""

import asyncio
import contextlib
import secrets
import sys
import time
from pathlib import Path
from typing import Final, Literal, Self, TextIO

from resonator_daemon.base.errors import ExitCode, UserError, meaning_of
from resonator_daemon.base.host.files import NoNewFileError, check_new, takes_a_stream
from resonator_daemon.base.host.text import printable
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.codec import Encoded, Outgoing, encode
from resonator_daemon.mqtt.daemon_state import DaemonSnapshot, DaemonState
from resonator_daemon.mqtt.message_account import Cause
from resonator_daemon.mqtt.payloads import Condition, Lost, Message, State
from resonator_daemon.mqtt.publisher import Publisher, Subscription
from resonator_daemon.mqtt.requests import BrokerUnreachableError, NoDaemonError, find_plate, reach
from resonator_daemon.mqtt.topics import STATE_DAEMON, Headers, full_topic
from resonator_daemon.tools.replay.recorded_pipeline import Published


class FileOutput:
    """One line of JSON for each message, in a new file, on stdout, or to a character device or a pipe.

    A new file without any message is removed again.

    Raises
    ------
    NoNewFileError
        The file is there already, or cannot be made.
    UserError
        It cannot be extended.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._closing = contextlib.ExitStack()
        self._file: TextIO = sys.stdout
        self._removable = False  # a new file without a message, which would stand in the way of the next try

    async def __aenter__(self) -> Self:
        if str(self._path) != "-":
            check_new(self._path)
            is_stream = takes_a_stream(self._path)
            mode: Literal["w", "x"] = "w" if is_stream else "x"
            try:
                self._file = self._closing.enter_context(self._path.open(mode, encoding="utf-8"))
                self._removable = not is_stream
            except OSError as error:
                raise NoNewFileError(f"{self._path} cannot be made: {meaning_of(error)}") from error
        return self

    async def __aexit__(self, _kind: object, error: BaseException | None, _where: object) -> None:
        try:
            self._closing.close()
            if self._removable:
                self._path.unlink(missing_ok=True)
        except OSError as failure:
            if error is None:
                raise self._failed(failure) from failure

    async def put(self, published: Published) -> None:
        self._removable = False
        try:
            self._file.write(line(published) + "\n")
        except OSError as error:
            if self._file is sys.stdout and isinstance(error, BrokenPipeError):
                raise  # the reader has closed the pipe, as `head`
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> UserError:
        text = f"{self._path}: {meaning_of(error)}; what was written stays"
        return UserError(text, code="output", exit_code=ExitCode.FAILED)


def payload_json(message: Message | Encoded) -> str:
    """Return what is published as JSON; for a message with arrays, the same keys with rows of numbers."""
    if isinstance(message, Encoded):
        return message.payload.decode()
    return message.model_dump_json(fallback=lambda array: array.tolist())


def line(published: Published) -> str:
    """Return topic and payload as one JSON object."""
    return f'{{"topic":"{published.topic.path}","payload":{payload_json(published.message)}}}'


LOOK_S: Final = 1.0  # for what the broker has retained
CONNECT_S: Final = 10.0
WAITING_MAX: Final = 500  # messages; far below what would be dropped

_TURN_S: Final = 1e-3


class BrokerOutput:
    """Publishes under a name, as fast as the broker accepts it: nothing is dropped during a connection.

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
        Of the messages.

    Raises
    ------
    BrokerUnreachableError
        The broker does not accept a connection.
    UserError
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
        """Number of messages that subscribers lack, by cause, as a lost connection."""
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
            raise BrokerUnreachableError(f"the broker at {where} accepts no connection; see the reason above") from None
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
            await self._room(0)  # this state would replace one that waits
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
        try:
            daemon = await find_plate(self._mqtt, self._name, LOOK_S)
        except NoDaemonError:
            return
        if daemon.state is not Condition.OFFLINE:
            state = f"{daemon.state}: {printable(daemon.reason)}"
            taken = f"a daemon publishes as {self._base} ({state}); stop it, or give --name"
            raise UserError(taken, code="name_taken", exit_code=ExitCode.UNAVAILABLE)

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
