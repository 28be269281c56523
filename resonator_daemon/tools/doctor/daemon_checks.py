"""The daemon that has a link already: how it is found, and the findings by its own status."""

import asyncio
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import aclosing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.host.text import page
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.config import load_config
from resonator_daemon.board.config.clients import Client
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.daemon.monitoring.status_client import Answer, ask_all
from resonator_daemon.mqtt import requests
from resonator_daemon.mqtt.payloads import Condition
from resonator_daemon.mqtt.subscriber import subscribe
from resonator_daemon.mqtt.topics import TOPICS
from resonator_daemon.tools.doctor import link_checks, sensor_checks
from resonator_daemon.tools.doctor.finding import Area, Check, Finding, downgraded, not_checked
from resonator_daemon.tools.doctor.link_checks import ERRORS_FAULT

RUNS: Final = Check("daemon.runs", Area.SOFTWARE, "running daemon")
CONFIG: Final = Check("daemon.config", Area.SOFTWARE, "configuration in use")
LINK: Final = Check("daemon.link", Area.WIRING, "link, as the daemon reports it")
SENSOR: Final = Check("daemon.sensor", Area.SENSOR, "sensor, as the daemon reports it")
BROKER: Final = Check("daemon.broker", Area.SOFTWARE, "broker, as the daemon reports it")

# Who moves a board plugs it in again; a loose plug does so all day.
_REOPENED: Final = replace(link_checks.STEADY, unit="1/h", warning_above=3.0, fault_above=None)
_FRAMES_MIN: Final = 100
_DAMAGE: Final = ("damaged", "link_gap")  # causes of loss that a cable can have
_WATCHED: Final = (Condition.DRIFTING, Condition.UNCALIBRATED)  # states in which a sensor measures on
_REMEDIES: Final[Mapping[Any, str]] = {
    Condition.PRESSED_AT_START: "take everything off the plate: measuring begins once it is untouched",
    Condition.DRIFTING: "leave the plate untouched, away from heat and draughts, until its temperature is steady",
    Condition.UNCALIBRATED: sensor_checks.CALIBRATE,
}

_STATUS_TOPICS: Final = ("state/daemon", "state/link", "state/sensor", "health")
_NS_MAX: Final = 2**63
_STATUS_S: Final = 4.0  # the broker has the states, health comes each second


def check_daemon(answer: Answer) -> Iterator[Finding]:
    """Yield the findings on a running daemon; its answer is foreign, and may lack anything."""
    status = answer.status
    if status is None:
        if os.access(answer.socket, os.R_OK | os.W_OK):
            yield RUNS.fault(f"{answer.socket}: {answer.problem}", "restart it, if it does not recover")
        else:
            yield RUNS.not_checked(f"{answer.socket}: {answer.problem}")
        return
    yield from check_status(status, "its socket")


def check_status(status: Mapping[str, Any], where: str) -> Iterator[Finding]:
    """Yield the findings on a daemon's status; what the status leaves out is not checked."""
    pid = f" as pid {status['pid']}" if "pid" in status else ""
    yield RUNS.ok(f"it runs{pid} and has the link; what follows is from its status over {where}")
    if config := _table(status, "config"):
        yield from _config(config)
    link = _table(status, "link")
    busy = str(link.get("reason", "")) if link.get("reason_code") == ReasonCode.COMPUTER_BUSY else ""
    if busy:
        yield link_checks.COMPUTER_BUSY.fault(busy)
    if link.get("state") == Condition.ONLINE:
        yield LINK.ok(f"online {link.get('reason', '')}".strip())
        yield from _losses(_table(status, "health"), _table(link, "last_outage"))
    else:
        remedy = f"see the reason and {page('how-to/connect.md')}"
        found = LINK.fault(f"{link.get('state')}: {link.get('reason')}", remedy)
        yield downgraded(found, "the computer is busy" if busy else "")
    yield _sensor(_table(status, "sensor"), online=link.get("state") == Condition.ONLINE)
    broker = _table(status, "broker")
    if broker.get("connected"):
        yield BROKER.ok(f"connected to {broker.get('url')}")
    else:
        yield BROKER.warning(f"not connected to {broker.get('url')}", "see what is found of the broker itself")


def _sensor(sensor: Mapping[str, Any], *, online: bool) -> Finding:
    state = sensor.get("state")
    remedy = _REMEDIES.get(state, "stop the daemon and retry: then each tone is examined")
    words = f"{state}: {sensor.get('reason')}"
    if not online:
        return SENSOR.not_checked("no frames come")
    if state == Condition.ONLINE:
        return SENSOR.ok(words)
    if state is None or state == Condition.STARTING:
        return SENSOR.not_checked(words if state else "the daemon has not reported it yet")
    return SENSOR.warning(words, remedy) if state in _WATCHED else SENSOR.fault(words, remedy)


def _config(config: Mapping[str, Any]) -> Iterator[Finding]:
    problems = "; ".join(str(problem) for problem in config.get("problems") or ())
    if problems or config.get("in_use") == "last_good":
        works = "works by the last good one" if config.get("in_use") == "last_good" else "refused the changed file"
        yield CONFIG.fault(f"it {works}: {problems}", f"correct {config.get('file')} (resonatord check), then reload")
    elif config.get("needs_restart"):
        keys = ", ".join(str(key) for key in config["needs_restart"])
        yield CONFIG.warning(f"{keys} in the file are not in effect yet", "restart the daemon")
    else:
        yield CONFIG.ok(str(config.get("file")))


def _losses(health: Mapping[str, Any], last_outage: Mapping[str, Any]) -> Iterator[Finding]:
    boots = health.get("boots") or ()
    if not boots:
        checks = (link_checks.STEADY, link_checks.ERRORS, link_checks.OVERFLOW)
        yield from not_checked(checks, "the daemon has not reported its health yet")
        return
    yield _steady(health, last_outage)
    present = boots[-1]
    lost, in_outages = _table(present, "lost"), _table(present, "lost_in_outages")
    beside = {cause: int(count) - int(in_outages.get(cause, 0)) for cause, count in lost.items()}
    hit = sum(beside.get(cause, 0) for cause in _DAMAGE)
    if not in_outages:  # of an earlier version of the daemon
        hit = max(hit - int(last_outage.get("frames_lost", 0)), 0)
    frames = int(present.get("frames", 0)) + hit
    if frames < _FRAMES_MIN:
        few = f"{frames} frames, at least {_FRAMES_MIN} are needed"
        yield from not_checked((link_checks.ERRORS, link_checks.OVERFLOW), few)
        return
    dropped = max(beside.get("board_overflow", 0), 0)
    yield link_checks.overflow(dropped, frames + dropped)
    since = f"outside outages, since the later start of daemon and board (limit {ERRORS_FAULT:g})"
    yield link_checks.ERRORS.judged(hit / frames, f"{hit} of {frames} frames damaged or lost {since}")


def _steady(health: Mapping[str, Any], last_outage: Mapping[str, Any]) -> Finding:
    """Return how often the link was opened again; an outage that is over is known, and no damage."""
    reopened = max(int(health.get("connections", 1)) - 1, 0)
    per_hour = reopened / max(float(health.get("uptime_s", 0.0)) / 3600.0, 1.0)
    outage = "no outage so far"
    if last_outage:
        outage = (
            f"the last outage, of {last_outage.get('frames_lost')} frames, ended at "
            f"{utc_text(last_outage.get('end_t_ns'))}: {last_outage.get('reason')}"
        )
    return _REOPENED.judged(per_hour, f"opened again {reopened} times since the daemon's start; {outage}")


def _table(status: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = status.get(name)
    return value if isinstance(value, dict) else {}


async def find_daemon(link: LinkTarget, config_path: Path | None, pids: Collection[int]) -> Answer | None:
    """Return what the daemon of this computer answers that has a link; None where none does.

    It is the one that holds the port, as `pids` do, or was started with `config_path`, or with another file that names
    the same link.
    """
    for answer in await ask_all(None):
        if answer.status is None:
            if config_path is not None and answer.socket.parent.name == config_path.stem:
                return answer
        elif answer.status.get("pid") in pids or _has(answer.status, link, config_path):
            return answer
    return None


async def config_used_by(config_path: Path) -> str:
    """Return what configuration a daemon goes on with whose file cannot be used; empty where none runs."""
    for answer in await ask_all(config_path.stem):
        config = (answer.status or {}).get("config")
        if not isinstance(config, dict) or answer.status is None or answer.socket.parent.name != config_path.stem:
            continue
        copy = "an earlier run's copy of it" if config.get("in_use") == "last_good" else "this file as it was"
        return (
            f"a daemon runs all the same (pid {answer.status.get('pid')}), by {copy}, read at "
            f"{utc_text(config.get('loaded_t_ns'))}; "
            f"see: resonatord status {config_path.stem}"
        )
    return ""


def utc_text(t_ns: object) -> str:
    """Return a time of a message, a decimal string of nanoseconds, as date and time of day."""
    if not isinstance(t_ns, str) or not t_ns.isdecimal() or not 0 <= int(t_ns[:20]) < _NS_MAX:
        return "an unknown time"
    return datetime.fromtimestamp(int(t_ns) // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _has(status: Mapping[str, Any], link: LinkTarget, config_path: Path | None) -> bool:
    config = status.get("config")
    if not isinstance(config, dict) or not isinstance(config.get("file"), str):
        return False
    file = Path(f"/proc/{status.get('pid')}/cwd") / config["file"]
    try:
        if config_path is not None and file.samefile(config_path):
            return True
        return "link" not in config.get("needs_restart", ()) and load_config(file).link.same_board(link)
    except (OSError, ValueError, UserError):
        return False  # its file is not for this user to read, or has changed since


async def published_status(broker: Mqtt, name: str | None, link: LinkTarget) -> dict[str, Any] | None:
    """Return the status that a daemon publishes, as its socket would give it; None where none comes in time.

    Without a name it is that of a daemon on the board of `link`.
    """
    status: dict[str, Any] = {}
    topics = tuple(TOPICS[path] for path in _STATUS_TOPICS)
    try:
        plate = await requests.find_daemon(Client.model_construct(name=name, link=link, mqtt=broker))
        async with asyncio.timeout(_STATUS_S), aclosing(subscribe(broker, topics, plate=plate)) as messages:
            async for _, path, message in messages:
                status[path.removeprefix("state/")] = message.model_dump(mode="json")
                if len(status) == len(topics):
                    return {**status, "broker": {"connected": True, "url": broker.anonymous().url}}
    except (TimeoutError, requests.NoDaemonError):
        pass
    return None
