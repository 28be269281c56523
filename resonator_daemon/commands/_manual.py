"""Pages of the manual, made from the parser of the command line, as its help is."""

import argparse
import re
from collections.abc import Iterator
from importlib.metadata import version
from typing import Final

from resonator_daemon.commands._command_line import make_parser, parsers
from resonator_daemon.host.documentation import with_pages

PLACE: Final = "/usr/local/share/man/man1"


def manual() -> Iterator[tuple[str, str]]:
    """Yield place and text of a page for `resonatord`, for each command, and for each group of commands."""
    release = version("resonatord")
    for words, parser in parsers(make_parser()):
        vars(parser)["color"] = False  # of Python 3.14, on a terminal
        name = words.replace(" ", "-")
        yield f"{PLACE}/{name}.1", "\n".join(_page(name, parser, release)) + "\n"


def _page(name: str, parser: argparse.ArgumentParser, release: str) -> Iterator[str]:
    description = parser.description or ""
    usage = " ".join(parser.format_usage().removeprefix("usage: ").split())
    yield f'.TH {_text(name.upper())} 1 "" "resonatord {release}" "resonatord"'
    yield from (".SH NAME", f"{_text(name)} \\- {_text(re.split(r'[.:] ', description)[0].removesuffix('.'))}")
    yield from (".SH SYNOPSIS", f".B {_text(usage)}")
    yield from (".SH DESCRIPTION", _text(description))
    for group in parser._action_groups:  # noqa: SLF001 - argparse has no other way to list arguments
        actions = [action for action in group._group_actions if action.help is not argparse.SUPPRESS]  # noqa: SLF001
        if actions:
            yield f".SH {_text((group.title or 'arguments').upper())}"
        for action in actions:
            yield from _entries(parser, action)
    if parser.epilog:
        yield from (".SH NOTES", _text(parser.epilog))
    if " " in parser.prog:
        yield from (".SH SEE ALSO", r".BR resonatord (1)")


def _entries(parser: argparse.ArgumentParser, action: argparse.Action) -> Iterator[str]:
    if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
        for choice in action._choices_actions:  # noqa: SLF001 - the help of commands is nowhere else
            page = f"{parser.prog} {choice.dest}".replace(" ", "-")
            yield from (".TP", f".BR {_text(page)} (1)", _text(choice.help or ""))
        return
    formatter = parser._get_formatter()  # noqa: SLF001
    yield from (".TP", f".B {_text(formatter._format_action_invocation(action))}")  # noqa: SLF001
    yield _text(formatter._expand_help(action)) if action.help else ""  # noqa: SLF001 - with its defaults


def _text(text: str) -> str:
    """Return a line of text with the signs escaped that roff takes as commands."""
    escaped = with_pages(text).replace("\\", "\\e").replace("-", "\\-").replace('"', "\\(dq").replace("`", "\\(ga")
    return f"\\&{escaped}" if escaped.startswith((".", "'")) else escaped
