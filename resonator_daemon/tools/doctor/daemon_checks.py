"""The daemon that has a link already: how it is found, and the findings by its own status."""

import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.host.text import page
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.config import load_config
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.daemon.monitoring.status_client import Answer, ask_all
from resonator_daemon.mqtt.payloads import Condition
from resonator_daemon.tools.doctor import link_checks
from resonator_daemon.tools.doctor.finding import STATE_REMEDIES, Finding, downgraded, make_check, not_checked
from resonator_daemon.tools.doctor.link_checks import ERRORS_FAULT

RUNS: Final = make_check("daemon.runs")
LINK: Final = make_check("daemon.link")
SENSOR: Final = make_check("daemon.sensor")

_FRAMES_MIN: Final = 100
_DAMAGE: Final = ("damaged", "link_gap")  # causes of loss that a cable can have
_WATCHED: Final = (Condition.DRIFTING, Condition.UNCALIBRATED)  # states in which a sensor measures on


def check_daemon(answer: Answer) -> Iterator[Finding]:
    """Yield the findings on a running daemon; its answer is foreign, and may lack anything."""
    status = answer.status
    if status is None:
        if os.access(answer.socket, os.R_OK | os.W_OK):
            yield RUNS.fault(f"{answer.socket}: {answer.problem}", "restart it, if it does not recover")
        else:
            yield RUNS.not_checked(f"{answer.socket}: {answer.problem}")
        return
    pid = f" as pid {status['pid']}" if "pid" in status else ""
    yield RUNS.ok(f"it runs{pid} and has the link; what follows is from its status")
    link = _table(status, "link")
    busy = str(link.get("reason", "")) if link.get("reason_code") == ReasonCode.COMPUTER_BUSY else ""
    if busy:
        yield link_checks.COMPUTER_BUSY.fault(busy)
    if link.get("state") == Condition.ONLINE:
        yield LINK.ok(f"online {link.get('reason', '')}".strip())
        yield from _losses(_table(status, "health"))
    else:
        remedy = f"see the reason and {page('how-to/connect.md')}"
        found = LINK.fault(f"{link.get('state')}: {link.get('reason')}", remedy)
        yield downgraded(found, "the computer is busy" if busy else "")
    yield _sensor(_table(status, "sensor"), online=link.get("state") == Condition.ONLINE)


def _sensor(sensor: Mapping[str, Any], *, online: bool) -> Finding:
    state = sensor.get("state")
    remedy = STATE_REMEDIES.get(state, "stop the daemon and retry: then each tone is examined")
    words = f"{state}: {sensor.get('reason')}"
    if not online:
        return SENSOR.not_checked("no frames come")
    if state == Condition.ONLINE:
        wrong = STATE_REMEDIES.get(sensor.get("reason_code"))
        return SENSOR.warning(words, wrong) if wrong else SENSOR.ok(words)
    if state is None or state == Condition.STARTING:
        return SENSOR.not_checked(words if state else "the daemon has not reported it yet")
    return SENSOR.warning(words, remedy) if state in _WATCHED else SENSOR.fault(words, remedy)


def _losses(health: Mapping[str, Any]) -> Iterator[Finding]:
    boots = health.get("boots") or ()
    if not boots:
        yield from not_checked((link_checks.ERRORS, link_checks.OVERFLOW), "the daemon has not reported its health yet")
        return
    present = boots[-1]
    lost, in_outages = _table(present, "lost"), _table(present, "lost_in_outages")
    beside = {cause: int(count) - int(in_outages.get(cause, 0)) for cause, count in lost.items()}
    hit = sum(beside.get(cause, 0) for cause in _DAMAGE)
    frames = int(present.get("frames", 0)) + hit
    if frames < _FRAMES_MIN:
        few = f"{frames} frames, at least {_FRAMES_MIN} are needed"
        yield from not_checked((link_checks.ERRORS, link_checks.OVERFLOW), few)
        return
    dropped = max(beside.get("board_overflow", 0), 0)
    yield link_checks.overflow(dropped, frames + dropped)
    since = f"outside outages, since the later start of daemon and board (limit {ERRORS_FAULT:g})"
    yield link_checks.ERRORS.judged(hit / frames, f"{hit} of {frames} frames damaged or lost {since}")


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
