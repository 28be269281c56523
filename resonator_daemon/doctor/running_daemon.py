"""Finds the daemon that has a link already, so that nobody takes it away: by its socket, or by what it publishes."""

import asyncio
from collections.abc import Collection, Mapping
from contextlib import aclosing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from resonator_daemon.config import Mqtt, load_config
from resonator_daemon.errors import UserError
from resonator_daemon.links.table import parse_link
from resonator_daemon.links.target import LinkTarget
from resonator_daemon.monitoring.status_client import Answer, ask_all
from resonator_daemon.publishing.payloads import Condition, Info
from resonator_daemon.publishing.subscriber import subscribe
from resonator_daemon.publishing.topics import TOPICS

_STATUS_TOPICS: Final = ("info", "state/daemon", "state/link", "state/sensor", "health")
_NS_MAX: Final = 2**63
LOOK_S, _STATUS_S = 2.0, 4.0  # the broker has the states, health comes each second


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


async def works_by(config_path: Path) -> str:
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
        return "link" not in config.get("needs_restart", ()) and load_config(file).link.leads_to_the_same(link)
    except (OSError, ValueError, UserError):
        return False  # its file is not for this user to read, or has changed since


async def published_status(broker: Mqtt, name: str | None, link: LinkTarget) -> dict[str, Any] | None:
    """Return the status that a daemon publishes, as its socket would give it; None where none comes in time.

    Without a name it is that of the daemon whose status names `link`.
    """
    plates: dict[str, dict[str, Any]] = {}
    topics = tuple(TOPICS[path] for path in _STATUS_TOPICS)
    try:
        async with asyncio.timeout(LOOK_S) as limit, aclosing(subscribe(broker, topics)) as messages:
            async for plate, path, message in messages:
                status = plates.setdefault(plate, {})
                if isinstance(message, Info):
                    status["is_ours"] = _names(message.link, link)
                else:
                    status[path.removeprefix("state/")] = message.model_dump(mode="json")
                wanted = plate == name if name else status.get("is_ours")
                if wanted and "daemon" in status and status["daemon"].get("state") != Condition.ONLINE:
                    return None
                if wanted and path in ("info", "state/daemon"):
                    limit.reschedule(asyncio.get_running_loop().time() + _STATUS_S)
                if wanted and status.keys() >= {"daemon", "link", "sensor", "health"}:
                    return {**status, "broker": {"connected": True, "url": broker.anonymous().url}}
    except TimeoutError:
        pass
    return None


def _names(text: str, link: LinkTarget) -> bool:
    try:
        return parse_link(text).leads_to_the_same(link)
    except ValueError:
        return False  # a later version's kind of link
