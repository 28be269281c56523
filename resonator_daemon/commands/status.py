"""Print the status of the daemons on this computer.

Example: resonatord status left-index
"""

import argparse
from typing import TYPE_CHECKING

from resonator_daemon.base.errors import ExitCode, UserError
from resonator_daemon.base.host.text import printable
from resonator_daemon.tools.command_line import finish, print_page

if TYPE_CHECKING:
    from resonator_daemon.daemon.monitoring.status_client import Answer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME|FILE",
        help="that a daemon publishes under; or its configuration, as left-index.toml or left-index (default: all)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print the status; UserError where no daemon runs, or one does not answer."""
    import asyncio

    from resonator_daemon.daemon.monitoring.status_client import ask_all
    from resonator_daemon.tools.view.status_block import status_page

    answers = asyncio.run(ask_all(arguments.name))
    if answers and not arguments.json:
        print_page(status_page(answers), soft_wrap=True)
    return finish(arguments, _checked(answers, arguments.name))


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
    text = f"{who} runs on this computer, by what is in {places}; start one: resonatord run FILE"
    return UserError(text, code="no_daemon", exit_code=ExitCode.FAILED)
