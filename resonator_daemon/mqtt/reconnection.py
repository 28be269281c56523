"""Keeps one connection to a broker: MQTT 5 or else 3.1.1, new attempts with back-off, one log line per change."""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any

from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.base.errors import reason_of
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import connecting
from resonator_daemon.mqtt.broker_connection import MQTT_3, MQTT_5, BrokerConnection, ConnectionTimes
from resonator_daemon.mqtt.connecting import BrokerError
from resonator_daemon.mqtt.pacing import Backoff

log = logging.getLogger(__name__)

Report = Callable[[int, str], None]


async def keep_connected(
    broker: Mqtt,
    make_connection: Callable[[MQTTProtocolVersion], BrokerConnection],
    serve: Callable[[BrokerConnection], Awaitable[None]],
    closing: asyncio.Future[None],
    *,
    report: Report = log.log,
    on_failure: Callable[[Exception], None] = lambda _: None,
    times: ConnectionTimes | None = None,
) -> None:
    """Make one connection after the other until `closing` is done; then the last one is closed with DISCONNECT.

    Parameters
    ----------
    broker
    make_connection
        Makes the next connection, of a version of MQTT that the broker supports.
    serve
        Called with a connection that the broker has accepted. It is cancelled when the connection is over, may end
        before, and may raise BrokerError to give it up: then the broker publishes the will.
    closing
    report
        Called with level and text of a log line when the connection changes, once per change.
    on_failure
        Called with the error of each attempt that fails, and of each connection that is lost.
    times
    """
    loop = asyncio.get_running_loop()
    times = times or ConnectionTimes()
    pauses = Backoff(times.first_pause_s)
    version: MQTTProtocolVersion | None = None
    reported: str | None = None

    def report_change(level: int, text: str) -> None:
        nonlocal reported
        if text != reported:
            report(level, f"broker {broker.host}:{broker.port}: {text}")
        reported = text

    while not closing.done():
        longest_pause_s = times.longest_pause_s
        accepted_s: float | None = None
        try:
            version = version or await find_version(broker, closing, times)
            if version is None or not await _connect(connection := make_connection(version), closing):
                return
            accepted_s = loop.time()
            report_change(logging.INFO, f"connected, MQTT {'5' if version is MQTT_5 else '3.1.1'}")
            await _serve_until_over(serve(connection), connection, closing)
        except (BrokerError, OSError) as caught:
            error = connecting.of_answer(caught, broker)
            on_failure(error)
            refused = isinstance(error, connecting.RefusalError)
            if refused:
                longest_pause_s = times.refused_pause_s
            if broker.username is None or version is MQTT_3 or not (accepted_s is not None or refused):
                version = None  # another broker may answer next time; else one attempt without a user name is spared
            answered = connecting.code_of(error) != connecting.UNSPECIFIED
            reason = reason_of(error) if isinstance(error, OSError) else error
            report_change(logging.WARNING, f"{reason if answered else 'connection lost'}; trying again")
        if accepted_s is not None and loop.time() - accepted_s > times.stable_s:
            pauses.reset()
        await asyncio.wait([closing], timeout=pauses.next_s(longest_pause_s))


async def find_version(
    broker: Mqtt, closing: asyncio.Future[None], times: ConnectionTimes
) -> MQTTProtocolVersion | None:
    """Return the version of MQTT that a broker supports, by the simplest connection; None if closing comes first.

    A broker without version 5 may misread a will, a name or a password in a connection of that version, and wait for
    the rest of it without end, instead of refusing (amqtt 0.12 does). Any answer but "unsupported version" is one of
    MQTT 5, "not authorised" too.

    Raises
    ------
    BrokerError
        The broker cannot be reached or does not answer.
    """
    probe = BrokerConnection(broker.anonymous(), MQTT_5, times=times)
    try:
        if not await _connect(probe, closing):
            return None
    except connecting.RefusalError:
        raise
    except connecting.NoAnswerError:
        if broker.username is None:
            raise
    except BrokerError as error:
        if error.code is None:
            raise
        return MQTT_3 if error.code == connecting.UNSUPPORTED_VERSION else MQTT_5
    else:
        await probe.disconnect()
    return MQTT_5


async def _connect(connection: BrokerConnection, closing: asyncio.Future[None]) -> bool:
    """Connect; return False if closing comes first."""
    connecting = asyncio.ensure_future(connection.connect())
    ends: list[asyncio.Future[Any]] = [connecting, closing]
    try:
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
    finally:
        if not connecting.done():
            connecting.cancel()
            await asyncio.wait([connecting])
    if connecting.cancelled():
        return False
    connecting.result()
    return True


async def _serve_until_over(work: Awaitable[None], connection: BrokerConnection, closing: asyncio.Future[None]) -> None:
    serving = asyncio.ensure_future(work)
    over: list[asyncio.Future[Any]] = [connection.lost, closing]
    try:
        try:
            await asyncio.wait([serving, *over], return_when=asyncio.FIRST_COMPLETED)
            if serving.done() and serving.exception() is None:
                await asyncio.wait(over, return_when=asyncio.FIRST_COMPLETED)
        finally:
            serving.cancel()
            await asyncio.wait([serving])
        if not serving.cancelled():
            serving.result()
        if not closing.done():
            connection.lost.result()
            raise BrokerError("connection lost")
        if connection.writable:
            await connection.disconnect()
    finally:
        connection.abort()
