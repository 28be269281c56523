"""Comparison of a known load with the force that the running daemon publishes."""

import asyncio
import math
from contextlib import aclosing
from typing import Final, NamedTuple

from resonator_daemon.base.host.text import print_note
from resonator_daemon.board.config import Config
from resonator_daemon.mqtt.payloads import Contacts
from resonator_daemon.mqtt.requests import BrokerUnreachableError, reach
from resonator_daemon.mqtt.subscriber import EVERY_PLATE, subscribe
from resonator_daemon.mqtt.topics import CONTACTS, TOPICS
from resonator_daemon.tools.doctor.finding import Finding, make_check

LOAD: Final = make_check("sensor.load", "standard deviations", warning_above=2.0, fault_above=3.0)
_WAIT_S: Final = 60.0
_SILENCE_S: Final = 5.0  # in which a daemon publishes
_STILL_NS: Final = 1_000_000_000  # for which a load must lie
_STEADY: Final = 0.02  # relative change of the force, below which the load is steady ...
_SIGNIFICANT: Final = 4.0  # ... and standard deviations beyond it


_NOTHING: Final = "nothing is published: start resonatord run"


class _Load(NamedTuple):
    """All contacts of a moment, in N."""

    t_ns: int
    force: float
    noise: float
    systematic: float  # the errors of contacts have the same cause

    @classmethod
    def of(cls, message: Contacts) -> "_Load":
        force = noise2 = systematic = 0.0
        for contact in message.contacts:
            force += contact.force_newton[2]
            noise2 += contact.noise_newton[2] ** 2
            systematic += contact.systematic_newton[2] if contact.systematic_newton is not None else math.nan
        return cls(message.t_ns, force, math.sqrt(noise2), systematic)


async def check_load(config: Config, newton: float) -> Finding:
    """Wait for a load that lies still, and compare it with the force that it should be."""
    last: dict[str, Contacts] = {}  # by plate
    try:
        await reach(config.mqtt)
        print_note(f"put a load of {newton:g} N on the plate, on a site, and leave it there; waiting for {_WAIT_S:g} s")
        async with asyncio.timeout(_SILENCE_S) as limit:
            loads = await _steady(config, last, limit)
    except BrokerUnreachableError as error:
        return LOAD.not_checked(str(error))
    except TimeoutError:
        if len(last) > 1:
            return LOAD.warning(f"several plates publish: {', '.join(sorted(last))}; set name in the configuration")
        seen = [f"contacts: {message.status} {message.reason_code or ''}" for message in last.values()]
        return LOAD.warning("; ".join(["no load lay still for a second", *seen]) if seen else _NOTHING)
    force = sum(load.force for load in loads) / len(loads)
    std = math.hypot(loads[-1].systematic, loads[-1].noise / math.sqrt(len(loads)))
    off = force - newton
    evidence = f"measured {force:.4g} N, load {newton:g} N: {100.0 * off / newton:+.1f} %; stated deviation {std:.2g} N"
    remedy = "resonatord calibrate skin --ball" if config.plate.skin is not None else LOAD.remedy
    return LOAD.judged(abs(off) / std if std > 0.0 else math.inf, evidence, remedy=remedy)


async def _steady(config: Config, last: dict[str, Contacts], limit: asyncio.Timeout) -> list[_Load]:
    """Return the loads of a second in which the force hardly changed; `last` gets the last message of each plate."""
    held: list[_Load] = []
    subscribed = subscribe(config.mqtt, (TOPICS[CONTACTS.path],), plate=config.name or EVERY_PLATE, full_rate=False)
    async with aclosing(subscribed) as messages:
        async for plate, _, message in messages:
            if not last:
                limit.reschedule(asyncio.get_running_loop().time() + _WAIT_S)
            if isinstance(message, Contacts):
                last[plate] = message
                load = _Load.of(message)
                is_steady = held and abs(load.force - held[0].force) < _STEADY * load.force + _SIGNIFICANT * load.noise
                held = [*held, load] if is_steady else [load]
                if len(last) == 1 and load.systematic > 0.0 and load.t_ns - held[0].t_ns >= _STILL_NS:
                    return held
    raise TimeoutError
