"""A daemon that runs on the link already: its own status, so that the link stays with it."""

import math
import os
from collections.abc import Iterator, Mapping
from typing import Any, Final

from resonator_daemon.doctor import link_checks, sensor_checks
from resonator_daemon.doctor.finding import Amount, Area, Check, Finding, graded, not_checked
from resonator_daemon.doctor.link_checks import ERRORS_FAULT
from resonator_daemon.doctor.running_daemon import utc_text
from resonator_daemon.monitoring.status_client import Answer
from resonator_daemon.publishing.payloads import Condition

RUNS: Final = Check("daemon.runs", Area.SOFTWARE, "running daemon")
CONFIG: Final = Check("daemon.config", Area.SOFTWARE, "configuration in use")
LINK: Final = Check("daemon.link", Area.WIRING, "link, as the daemon reports it")
SENSOR: Final = Check("daemon.sensor", Area.SENSOR, "sensor, as the daemon reports it")
BROKER: Final = Check("daemon.broker", Area.SOFTWARE, "broker, as the daemon reports it")

_FRAMES_MIN: Final = 100
_DAMAGE: Final = ("damaged", "link_gap")  # causes of loss that a cable can have
_REOPENINGS_PER_HOUR: Final = 3.0  # who moves a board plugs it in again; a loose plug does so all day
_WATCHED: Final = (Condition.DRIFTING, Condition.UNCALIBRATED)  # states in which a sensor measures on
_REMEDIES: Final[Mapping[Any, str]] = {
    Condition.PRESSED_AT_START: "take everything off the plate: measuring begins once it is untouched",
    Condition.DRIFTING: "leave the plate untouched, away from heat and draughts, until its temperature is steady",
    Condition.UNCALIBRATED: sensor_checks.CALIBRATE,
}


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
    if link.get("state") == Condition.ONLINE:
        yield LINK.ok(f"online {link.get('reason', '')}".strip())
        yield from _losses(_table(status, "health"), _table(link, "last_outage"))
    else:
        yield LINK.fault(f"{link.get('state')}: {link.get('reason')}", "see the reason and docs/how-to/connect.md")
    yield _sensor(_table(status, "sensor"), online=link.get("state") == Condition.ONLINE)
    broker = _table(status, "broker")
    if broker.get("connected"):
        yield BROKER.ok(f"connected to {broker.get('url')}")
    else:
        yield BROKER.warning(f"not connected to {broker.get('url')}", "see what is found of the broker itself")


def _sensor(sensor: Mapping[str, Any], *, online: bool) -> Finding:
    state = sensor.get("state")
    remedy = _REMEDIES.get(state, "stop the daemon and ask again: then the tones are looked at")
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
        yield from not_checked((link_checks.STEADY, link_checks.ERRORS), "the daemon has not reported its health yet")
        return
    yield _steady(health, last_outage)
    present = boots[-1]
    lost, in_outages = _table(present, "lost"), _table(present, "lost_in_outages")
    hit = sum(int(lost.get(cause, 0)) - int(in_outages.get(cause, 0)) for cause in _DAMAGE)
    if not in_outages:  # of an earlier version of the daemon
        hit = max(hit - int(last_outage.get("frames_lost", 0)), 0)
    frames = int(present.get("frames", 0)) + hit
    evidence = (
        f"{hit} of {frames} frames damaged or lost, outages aside, since the daemon has received this board "
        f"(limit {ERRORS_FAULT:g})"
    )
    if frames < _FRAMES_MIN:
        yield link_checks.ERRORS.not_checked(f"{frames} frames, at least {_FRAMES_MIN} are needed")
        return
    yield link_checks.ERRORS.judged(
        graded(hit / frames, 0.0, ERRORS_FAULT),
        evidence,
        link_checks.CABLE,
        Amount(hit / frames, ERRORS_FAULT),
    )


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
    evidence = f"opened again {reopened} times since the daemon's start; {outage}"
    return link_checks.STEADY.judged(
        graded(per_hour, _REOPENINGS_PER_HOUR, math.inf),
        evidence,
        link_checks.PLUG,
        Amount(per_hour, _REOPENINGS_PER_HOUR, "1/h"),
    )


def _table(status: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = status.get(name)
    return value if isinstance(value, dict) else {}
