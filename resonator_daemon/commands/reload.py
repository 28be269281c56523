"""Make a daemon of this computer read its configuration again, and print what changed.

The daemon's user and root may do this. A key that a running daemon does not apply waits for a restart; a file that
cannot be used changes nothing.

Example: resonatord reload left-index
"""

import argparse
import os
import signal
import sys
from typing import TYPE_CHECKING, Any, Final

from resonator_daemon.base.errors import ConfigurationError, ExitCode, UserError
from resonator_daemon.base.host.text import printable
from resonator_daemon.tools.command_line import finish

if TYPE_CHECKING:
    from resonator_daemon.daemon.monitoring.status_client import Answer

_LOOK_AGAIN_S: Final = 0.2  # an answer is at most 0.1 s old
_LIMIT_S: Final = 10.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name",
        metavar="NAME|FILE",
        help="that the daemon publishes under; or its configuration, as left-index.toml or left-index",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print each key that changed; raise ConfigurationError, and change nothing, if the file cannot be used."""
    import asyncio

    config = asyncio.run(_reload(arguments.name))
    problems, changes = config.get("problems", ()), config.get("changes", ())
    shown = {key: config[key] for key in ("file", "problems", "changes")}
    if problems:
        raise ConfigurationError(*problems, partial_result=shown, exit_code=ExitCode.FAILED)
    if not arguments.json:
        lines = [
            f"{change['key']}: {change['old']} -> {change['new']} "
            f"({'applied' if change['applied'] else 'after a restart'})"
            for change in changes
        ]
        sys.stdout.writelines(f"{printable(line)}\n" for line in lines or ["nothing changed"])
    return finish(arguments, shown)


async def _reload(name: str) -> dict[str, Any]:
    """Return `config` of the status after the daemon has read its file again."""
    import asyncio

    before = await _ask(name)
    pid, reloads = before["pid"], before["config"].get("reloads", 0)
    try:
        os.kill(pid, signal.SIGHUP)
    except PermissionError:
        who = f"process {pid} belongs to another user"
        raise _failed(f"{who}; with systemd: sudo systemctl reload resonatord@{before['instance']}", "denied") from None
    except ProcessLookupError:
        raise _failed(f"process {pid} has ended", "no_daemon") from None
    try:
        async with asyncio.timeout(_LIMIT_S):
            while True:
                await asyncio.sleep(_LOOK_AGAIN_S)
                after = (await _ask(name))["config"]
                if after.get("reloads", 0) != reloads:
                    return dict(after)
    except TimeoutError:
        words = f"process {pid} does not report that it read the file within {_LIMIT_S:g} s"
        raise _failed(words, "no_answer") from None


async def _ask(name: str) -> dict[str, Any]:
    from resonator_daemon.daemon.monitoring.status_client import ask_all

    answers: list[Answer] = await ask_all(name)
    if len(answers) != 1:
        what = "no daemon" if not answers else f"{len(answers)} daemons"
        raise _failed(f"{what} called {printable(name)}; see: resonatord status", "no_daemon")
    (answer,) = answers
    if answer.status is None or not isinstance(answer.status.get("config"), dict):
        raise _failed(f"{printable(name)}: {answer.problem or 'its answer is no status'}", "no_answer")
    return answer.status


def _failed(message: str, code: str) -> UserError:
    return UserError(message, code=code, exit_code=ExitCode.FAILED)
