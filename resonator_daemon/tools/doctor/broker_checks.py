"""The broker: does it listen, does it accept this user, and how quickly do messages come back."""

import asyncio
import contextlib
import secrets
import socket
import statistics
from collections.abc import Collection, Iterator
from typing import Final

from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.host.text import page
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt import connecting
from resonator_daemon.mqtt.broker_connection import MQTT_5, BrokerConnection, ConnectionTimes
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.reconnection import keep_connected
from resonator_daemon.mqtt.topics import full_topic
from resonator_daemon.tools.doctor.finding import Amount, Finding, downgraded, make_check, not_checked
from resonator_daemon.tools.doctor.host_checks import BusyCheck, Host

LISTENS: Final = make_check("broker.listens")
ACCEPTS: Final = make_check("broker.accepts")
ROUND_TRIP: Final = make_check("broker.round_trip", warning_above=0.1)

_CONNECT_S: Final = 5.0
ACCEPT_S: Final = 8.0
TURNS: Final = 15
_SOON_S: Final = 0.005  # who answers so soon after a message is taken for a conversation, and its acknowledgements wait
_PAUSE_S: Final = 0.06  # longer than an acknowledgement is delayed, so that each turn stands for itself
ANSWER_S: Final = 2.0
_SLOW_S: Final = 0.020  # in which 200 messages a second would already wait for each other
_TOPIC_LEVEL: Final = "doctor"


async def check_broker(broker: Mqtt, host: Host, times: ConnectionTimes | None = None) -> list[Finding]:
    """Return the findings on a broker in causal order; checks after the first fault are left out."""
    where = f"{broker.host}:{broker.port}"
    try:
        async with asyncio.timeout(_CONNECT_S):
            _, writer = await asyncio.open_connection(broker.host, broker.port)
    except (OSError, UnicodeError) as error:  # UnicodeError: a name that no host can have
        fault = LISTENS.fault(
            f"{where}: {meaning_of(error)}",
            f"start the broker, see that it listens on that address (and the firewall), or correct {broker.named_by}",
        )
        return [fault, *not_checked((ACCEPTS, ROUND_TRIP), "nobody listens")]
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    with BusyCheck(host) as busy_check:
        probe, last_text = await _measure(broker, times)
    return [LISTENS.ok(where), *_findings(broker, probe, last_text, busy_check.reason())]


class _Probe:
    """Sends messages to itself: one, soon after it a pair, and then nothing for longer than acknowledgements wait.

    A broker with Nagle's algorithm holds the second of a pair back until the first is acknowledged.
    """

    def __init__(self, broker: Mqtt, times: ConnectionTimes | None) -> None:
        self._times = times
        self._topic = full_topic(broker.prefix, _TOPIC_LEVEL, secrets.token_hex(8))
        self._arrived: dict[int, float] = {}
        self._came = asyncio.Event()
        self.sent: dict[int, float] = {}
        self.denied = ""
        self.version = ""
        self.accepted = asyncio.Event()
        self.done = asyncio.Event()

    @property
    def round_trips_s(self) -> list[float]:
        return [self._arrived[number] - at_s for number, at_s in self.sent.items() if number in self._arrived]

    def make_connection(self, broker: Mqtt, version: MQTTProtocolVersion) -> BrokerConnection:
        return BrokerConnection(broker, version, on_message=self._receive, times=self._times)

    async def serve(self, client: BrokerConnection) -> None:
        self.version = "MQTT 5" if client.version is MQTT_5 else "MQTT 3.1.1"
        self.accepted.set()
        if (denied := await client.subscribe(self._topic, qos=0)) is not None:
            self.denied = denied
            self.done.set()
            return
        for turn in range(TURNS):
            self._send(client, 3 * turn)
            await asyncio.sleep(_SOON_S)
            _delay_acknowledgements(client)
            self._send(client, 3 * turn + 1)
            self._send(client, 3 * turn + 2)
            await asyncio.sleep(_PAUSE_S)
        await self._await_rest()
        self.done.set()
        await asyncio.wait([client.lost])

    def _send(self, client: BrokerConnection, number: int) -> None:
        if client.writable:
            self.sent[number] = asyncio.get_running_loop().time()
            client.send(self._topic, str(number).encode(), qos=0)

    async def _await_rest(self) -> None:
        with contextlib.suppress(TimeoutError):  # what has not come by then is counted as not come
            async with asyncio.timeout(ANSWER_S):
                while len(self._arrived) < len(self.sent):
                    self._came.clear()
                    await self._came.wait()

    def _receive(self, message: Incoming) -> None:
        if message.payload.isdigit():
            self._arrived.setdefault(int(message.payload), asyncio.get_running_loop().time())
            self._came.set()


def _delay_acknowledgements(client: BrokerConnection) -> None:
    """Acknowledge as a socket does that has long been open; the system is quick about it on a new one."""
    if client.socket is not None:
        client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 0)


async def _measure(broker: Mqtt, times: ConnectionTimes | None) -> tuple[_Probe, str]:
    """Return the measurement and the last message on the connection."""
    probe, closing = _Probe(broker, times), asyncio.get_running_loop().create_future()
    last_text = ["no answer"]
    keeping = asyncio.create_task(
        keep_connected(
            broker,
            lambda version: probe.make_connection(broker, version),
            probe.serve,
            closing,
            report=lambda _, text: last_text.append(text),
            times=times,
        )
    )
    try:
        async with asyncio.timeout(ACCEPT_S):
            await probe.accepted.wait()
        async with asyncio.timeout(TURNS * _PAUSE_S + 3 * ANSWER_S):
            await probe.done.wait()
    except TimeoutError:
        pass  # reported below by what is missing
    finally:
        closing.set_result(None)
        await keeping
    return probe, last_text[-1]


def _findings(broker: Mqtt, probe: _Probe, last_text: str, busy: str) -> Iterator[Finding]:
    if not probe.accepted.is_set():
        silent = str(connecting.SilentError(broker)) in last_text
        remedy = f"correct the keys of [mqtt], or the broker's accounts; {page('how-to/secure-the-broker.md')}"
        if silent:
            named = f"see that {broker.named_by} names the broker's host and port"
            remedy = f"{named}, and that the broker is not stopped; restart it"
        yield ACCEPTS.fault(last_text.removesuffix("; trying again"), remedy)
        yield ROUND_TRIP.not_checked("the broker does not answer" if silent else "the broker does not take this user")
        return
    yield ACCEPTS.ok(probe.version)
    if probe.denied:
        yield ROUND_TRIP.not_checked(f"its access rules deny a topic to measure on ({probe.denied})")
        return
    times_s = probe.round_trips_s
    if not times_s:
        yield ROUND_TRIP.not_checked(
            f"none of {len(probe.sent)} messages came back: its access rules may deny them, which MQTT does not report"
        )
        return
    yield downgraded(_round_trip(times_s, len(probe.sent)), busy)


def _round_trip(times_s: Collection[float], sent: int) -> Finding:
    median_ms, worst_ms = 1e3 * statistics.median(times_s), 1e3 * max(times_s)
    evidence = f"{median_ms:.1f} ms median, {worst_ms:.1f} ms at worst, of {len(times_s)}"
    if len(times_s) < sent:
        return ROUND_TRIP.fault(
            f"{evidence}; {sent - len(times_s)} of {sent} did not come back within {ANSWER_S:g} s",
            "the broker, or the network to it, takes less than it is sent: look at its load and its limits",
            Amount(float(sent - len(times_s)), 0.0, "messages"),
        )
    slow = sum(time_s > _SLOW_S for time_s in times_s)
    evidence = f"{evidence}; {slow} took longer than {1e3 * _SLOW_S:g} ms"
    amount = Amount(float(slow), 0.1 * len(times_s), "messages")
    return ROUND_TRIP.judged(slow / len(times_s), evidence, amount=amount)
