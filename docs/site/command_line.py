"""Write the commands in docs/reference/command-line.md, from the parser: `python docs/site/command_line.py`.

An option that several commands explain in the same words is explained once, before the commands.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from resonator_daemon.commands._command_line import make_parser, parsers

PAGE = Path(__file__).parents[1] / "reference" / "command-line.md"
MARK = "<!-- commands: docs/site/command_line.py -->\n\n"
COMMON_FROM = 3  # commands
JSON = "- `--json`: print one JSON object"


def text() -> str:
    """Return the page with usage, arguments and notes of each command below its mark."""
    introduction, mark, _ = PAGE.read_text().partition(MARK)
    found = [(words, parser) for words, parser in parsers(make_parser())]
    counts = Counter(row for _, parser in found for row in rows(parser))
    often = {row.partition(":")[0]: row for row, number in reversed(counts.most_common()) if number >= COMMON_FROM}
    common = set(often.values())
    blocks = ["Arguments that several commands share:", "\n".join(row for row in counts if row in common)]
    blocks += [block for words, parser in found for block in section(words, parser, common)]
    return introduction + mark + "\n\n".join(blocks) + "\n"


def section(words: str, parser: argparse.ArgumentParser, common: set[str]) -> Iterator[str]:
    """Yield the blocks about one command, or about a group of commands."""
    yield f"## {words}"
    yield str(parser.description)
    yield f"    {usage(parser)}"
    if own := [row for row in rows(parser) if row not in common and not row.startswith(JSON)]:
        yield "\n".join(own)
    if parser.epilog and " " in words:  # the exit codes, which the program has, are on another page
        yield parser.epilog


def usage(parser: argparse.ArgumentParser) -> str:
    """Return the usage in one line, without the options that may be left out: the list has these."""
    actions = [action for action in parser._actions if action.dest != "help"]  # noqa: SLF001
    options = [action for action in actions if action.option_strings and not action.required]
    alternatives = [group for group in parser._mutually_exclusive_groups if group.required]  # noqa: SLF001
    shown = [action for group in alternatives for action in group._group_actions]  # noqa: SLF001
    formatter = parser._get_formatter()  # noqa: SLF001
    kept = [action for action in actions if action not in options or action in shown]
    formatter.add_usage(None, kept, alternatives, prefix="")
    line = " ".join(formatter.format_help().split())
    prog = parser.prog
    return line.replace(prog, f"{prog} [OPTION ...]", 1) if set(options) - set(shown) else line


def rows(parser: argparse.ArgumentParser) -> list[str]:
    """Return a line for each argument, and one for the commands of a group."""
    return [row for action in parser._actions for row in entries(parser, action)]  # noqa: SLF001


def entries(parser: argparse.ArgumentParser, action: argparse.Action) -> Iterator[str]:
    """Yield a line for an argument, or one for the commands of a group."""
    if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001 - argparse has no other way to list them
        names = [f"{parser.prog} {choice.dest}" for choice in action._choices_actions]  # noqa: SLF001
        yield "- " + ", ".join(f"[{name.rsplit(' ', 1)[1]}](#{name.replace(' ', '-')})" for name in names)
    elif action.help not in (None, argparse.SUPPRESS) and action.dest != "help":
        formatter = parser._get_formatter()  # noqa: SLF001
        value = formatter._format_args(action, action.dest.upper())  # noqa: SLF001
        names = ", ".join(action.option_strings)
        yield f"- `{' '.join(filter(None, (names, value)))}`: {formatter._expand_help(action)}"  # noqa: SLF001


if __name__ == "__main__":
    PAGE.write_text(text())
