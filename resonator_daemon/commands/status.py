"""Print the status of the daemons on this computer.

Example: resonatord status left-index --watch
"""

import argparse
import io
import sys
from contextlib import nullcontext, suppress
from typing import TYPE_CHECKING, Final

from resonator_daemon.base.errors import ExitCode, UserError
from resonator_daemon.base.host.text import printable
from resonator_daemon.tools.command_line import finish, print_failure, print_json

if TYPE_CHECKING:
    from resonator_daemon.daemon.monitoring.status_client import Answer

_PERIOD_S: Final = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME|FILE",
        help="that a daemon publishes under; or its configuration, as left-index.toml or left-index (default: all)",
    )
    parser.add_argument("--watch", action="store_true", help="again each second, until interrupted")
    parser.add_argument("--json", action="store_true", help="print one JSON object; with --watch one a line")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the status; UserError where no daemon runs, or one does not answer."""
    import asyncio

    if arguments.watch:
        asyncio.run(_watch(arguments.name, as_json=arguments.json))
        return ExitCode.DONE
    from rich.console import Console

    from resonator_daemon.tools.view.status_block import status_page

    answers = asyncio.run(_ask(arguments.name))
    if answers and not arguments.json:
        Console(highlight=False).print(status_page(answers), soft_wrap=True)
    return finish(arguments, _checked(answers, arguments.name))


async def _watch(name: str | None, *, as_json: bool) -> None:
    import asyncio

    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    from resonator_daemon.base.host.signals import on_signals
    from resonator_daemon.tools.view.status_block import status_page

    console = Console(highlight=False)
    lines = as_json or not console.is_terminal or console.is_dumb_terminal

    def show(answers: "list[Answer]", live: Live) -> None:
        page = status_page(answers) if answers else Text(str(_nobody(name)))
        if not lines:
            live.update(page, refresh=True)
        elif not as_json:
            console.print(page, Text(), soft_wrap=True)
        else:
            try:
                print_json({"verb": "status", "ok": True, **_checked(answers, name)})
            except UserError as error:
                print_failure("status", error)
        sys.stdout.flush()

    async def keep_asking() -> None:
        live = Live(console=console, screen=True, auto_refresh=False)
        with nullcontext() if lines else live:
            while True:
                show(await _ask(name), live)
                await asyncio.sleep(_PERIOD_S)

    asking = asyncio.create_task(keep_asking())
    with on_signals(asking.cancel), suppress(asyncio.CancelledError):
        await asking


async def _ask(name: str | None) -> "list[Answer]":
    from resonator_daemon.daemon.monitoring.status_client import ask_all

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that is not of UTF-8
    return await ask_all(name)


def _checked(answers: "list[Answer]", name: str | None) -> dict[str, object]:
    """Return the answers for programs; raise an error that has them where a daemon is missing or does not answer."""
    problems = [answer for answer in answers if answer.problem is not None]
    result: dict[str, object] = {
        "daemons": [answer.status for answer in answers if answer.problem is None],
        "problems": [{"socket": str(answer.socket), "problem": answer.problem} for answer in problems],
    }
    if problems or not answers:
        lines = [f"{answer.socket}: {answer.problem}" for answer in problems]
        failed = UserError(*lines, code="no_answer", exit_code=ExitCode.FAILED) if problems else _nobody(name)
        failed.partial_result = result
        raise failed
    return result


def _nobody(name: str | None) -> UserError:
    from resonator_daemon.base.host.files import runtime_directories

    places = ", ".join(str(place) for place in runtime_directories())
    who = "no daemon" if name is None else f"no daemon called {printable(name)}"
    text = f"{who} runs on this computer, by what is in {places}; start one: resonatord run"
    return UserError(text, code="no_daemon", exit_code=ExitCode.FAILED)
