"""`resonatord status`: how the daemons of this computer are, for people and for programs."""

import asyncio
import io
import json
import sys
import time
from typing import Any, Final

from pydantic import ValidationError
from rich.console import Console
from rich.live import Live
from rich.text import Text

from resonator_daemon.errors import ExitCode
from resonator_daemon.host.places import runtime_directories
from resonator_daemon.host.printable import printable
from resonator_daemon.monitoring.status import Status
from resonator_daemon.monitoring.status_client import Answer, ask_all
from resonator_daemon.view.status_block import status_block

_PERIOD_S: Final = 1.0


def status(name: str | None, *, watch: bool, as_json: bool) -> ExitCode:
    """Print how the daemons are; FAILED where none runs, or one gives no answer."""
    console = Console(highlight=False)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that is not of UTF-8
    if not watch:
        answers = asyncio.run(ask_all(name))
        if as_json:
            _print_json(answers)
        elif answers:
            columns = console.width if console.is_terminal else None  # else a line stays whole, as for grep
            console.print(_page(answers, columns), soft_wrap=columns is None)
        if not answers:
            sys.stderr.write(f"resonatord: {_nobody(name)}\n")
        return ExitCode.DONE if answers and not any(answer.problem for answer in answers) else ExitCode.FAILED
    if as_json or not console.is_terminal or console.is_dumb_terminal:
        while True:
            answers = asyncio.run(ask_all(name))
            if as_json:
                _print_json(answers)
            else:
                console.print(_page(answers, None) if answers else Text(_nobody(name)), Text(), soft_wrap=True)
                sys.stdout.flush()
            time.sleep(_PERIOD_S)
    with Live(console=console, screen=True, auto_refresh=False) as live:
        while True:
            answers = asyncio.run(ask_all(name))
            live.update(_page(answers, console.width) if answers else Text(_nobody(name)), refresh=True)
            time.sleep(_PERIOD_S)


def _page(answers: list[Answer], columns: int | None) -> Text:
    return Text("\n\n").join(_block(answer, columns) for answer in answers)


def _block(answer: Answer, columns: int | None) -> Text:
    problem = answer.problem
    if problem is None:
        try:
            return status_block(Status.model_validate_json(json.dumps(answer.status)), columns)
        except ValidationError as error:
            version = (answer.status or {}).get("version", "unknown")
            keys = ", ".join(sorted({".".join(map(str, found["loc"])) for found in error.errors()}))
            problem = f"its version {version} says of itself what this one cannot read ({keys}); --json shows it"
    return Text.assemble((answer.socket.parent.name, "bold"), "   ", (printable(problem), "yellow"))


def _print_json(answers: list[Answer]) -> None:
    said: dict[str, Any] = {
        "verb": "status",
        "daemons": [answer.status for answer in answers if answer.problem is None],
        "problems": [
            {"socket": str(answer.socket), "problem": answer.problem}
            for answer in answers
            if answer.problem is not None
        ],
    }
    sys.stdout.write(json.dumps(said) + "\n")
    sys.stdout.flush()


def _nobody(name: str | None) -> str:
    places = ", ".join(str(place) for place in runtime_directories())
    who = "no daemon" if name is None else f"no daemon called {printable(name)}"
    return f"{who} runs on this computer, by what is in {places}; start one: resonatord run"
