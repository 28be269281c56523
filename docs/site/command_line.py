"""Write the commands in docs/reference/command-line.md, from the parser: `python docs/site/command_line.py`."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from resonator_daemon.commands._command_line import make_parser, parsers

PAGE = Path(__file__).parents[1] / "reference" / "command-line.md"
MARK = "<!-- commands: docs/site/command_line.py -->\n\n"


def text() -> str:
    """Return the page with usage, arguments and notes of each command below its mark."""
    introduction, mark, _ = PAGE.read_text().partition(MARK)
    blocks = (block for words, parser in parsers(make_parser()) for block in section(words, parser))
    return introduction + mark + "\n\n".join(blocks) + "\n"


def section(words: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    """Yield the blocks about one command, or about a group of commands."""
    yield f"## {words}"
    yield str(parser.description)
    yield f"    {' '.join(parser.format_usage().removeprefix('usage: ').split())}"
    if rows := [row for action in parser._actions for row in entries(parser, action)]:  # noqa: SLF001
        yield "\n".join(rows)
    if parser.epilog:
        yield parser.epilog


def entries(parser: argparse.ArgumentParser, action: argparse.Action) -> Iterator[str]:
    """Yield a line for an argument, or for each command of a group."""
    if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001 - argparse has no other way to list them
        for choice in action._choices_actions:  # noqa: SLF001
            name = f"{parser.prog} {choice.dest}"
            yield f"- [{name}](#{name.replace(' ', '-')}): {choice.help}"
    elif action.help not in (None, argparse.SUPPRESS) and action.dest != "help":
        formatter = parser._get_formatter()  # noqa: SLF001
        value = formatter._format_args(action, action.dest.upper())  # noqa: SLF001
        names = ", ".join(action.option_strings)
        yield f"- `{' '.join(filter(None, (names, value)))}`: {formatter._expand_help(action)}"  # noqa: SLF001


if __name__ == "__main__":
    PAGE.write_text(text())
