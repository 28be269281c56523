"""Print which board is on a link and what it can do; a measuring board continues to measure.

Example: resonatord identify serial:/dev/ttyACM0?baud=4000000
"""

import argparse
import sys
from contextlib import closing
from typing import TYPE_CHECKING

from resonator_daemon.base.errors import ExitCode, IncompatibleBoardError, UsageError, UserError
from resonator_daemon.tools.command_line import add_link, finish, separate_config

if TYPE_CHECKING:
    from resonator_daemon.base.reasons import ReasonCode
    from resonator_daemon.board.links.target import LinkTarget
    from resonator_daemon.board.session.probe import ProbeResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_link(parser, "also check whether the board can serve it")
    parser.add_argument("--blink", action="store_true", help="make the board's LED blink, if it has one")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print what the board answers; IncompatibleBoardError where it cannot serve the configuration."""
    from resonator_daemon.board.config import load_config
    from resonator_daemon.board.session.compatibility import incompatibilities
    from resonator_daemon.tools.view.board_identity import as_json, labelled_lines

    separate_config(arguments)
    config = load_config(arguments.config) if arguments.config is not None else None
    link: LinkTarget | None = arguments.link or (config.link if config else None)
    if link is None:
        raise UsageError("name a LINK (see: resonatord ports) or --config FILE")
    result = _probe(link, blink=arguments.blink)
    problems = incompatibilities(result.described.description, config.plate) if config is not None else ()
    answer = as_json(link, result, problems, blink=arguments.blink)
    if not arguments.json:
        for label, value in labelled_lines(link, result, blink=arguments.blink):
            sys.stdout.write(f"{label:<15}{value}\n")
    if problems:
        raise IncompatibleBoardError(
            *(f"{arguments.config}: {problem.text}" for problem in problems), partial_result=answer
        )
    return finish(arguments, answer)


def _probe(target: "LinkTarget", *, blink: bool) -> "ProbeResult":
    from resonator_daemon.base.host.signals import interruptible
    from resonator_daemon.board.links.link import LinkUnavailableError
    from resonator_daemon.board.session.probe import NoBoardError, probe

    try:
        with interruptible("the board was not identified"), closing(target.open()) as link:
            return probe(link, blink=blink)
    except LinkUnavailableError as error:
        raise _no_answer(error.reason.code, str(error)) from error
    except NoBoardError as error:
        raise _no_answer(error.lost, f"no board answers on {target}: {error}") from error


def _no_answer(code: "ReasonCode | None", message: str) -> UserError:
    known = "port_in_use" if code == "port_in_use" else "no_board"
    return UserError(message, code=known, exit_code=ExitCode.UNAVAILABLE)
