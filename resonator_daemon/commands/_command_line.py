"""Parser of the command line, and errors of commands as exit codes and JSON."""

import argparse
import importlib
import io
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import Any, Final, NoReturn

from resonator_daemon import commands
from resonator_daemon.base.entry_points import entry_names, load_entry
from resonator_daemon.base.errors import (
    ConfigurationError,
    ExitCode,
    InterruptedCommandError,
    UsageError,
    UserError,
    check_open_files,
    reason_of,
)
from resonator_daemon.base.host.systemd import set_up_logging
from resonator_daemon.base.host.text import coloured, with_pages
from resonator_daemon.tools.command_line import print_error, print_failure

_ONE_OF: Final = "one of the arguments "


def run_command(words: Sequence[str]) -> int:
    """Run one command; return its exit code."""
    arguments = argparse.Namespace(command="")
    try:
        with _user_errors():
            make_parser(words).parse_args(words, arguments)  # which may print help and exit
            _set_up_output()
            return _run(arguments)
    except UserError as error:
        _report(arguments.command, error, as_json=getattr(arguments, "json", False))
        print_error(*error.messages)
        return error.exit_code
    except BrokenPipeError:  # the reader of the output has closed it, as `head` does
        _discard_output()
        return ExitCode.DONE


def _run(arguments: argparse.Namespace) -> int:
    commands.running = arguments.command
    check_open_files()
    try:
        code: int = arguments.run(arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:  # at the end of what can be interrupted
        raise InterruptedCommandError("interrupted") from None
    return code


def make_parser(words: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return the parser of the command that `words` begin with, or of all commands where they name none."""
    parser = _Parser(
        prog="resonatord",
        description="Acquisition daemon for a quartz-resonator tactile plate: forces, sites, contacts and surface "
        "traction, published over MQTT.",
        epilog="Exit codes: 0 done, or stopped by Ctrl-C if the command runs until stopped. "
        "1 the run failed (touches or frames lost) or was interrupted. "
        "2 wrong usage, or a missing recording. "
        "69 a link, board or broker is missing or unsuitable. "
        "78 the configuration is invalid, an output exists already or cannot be created, or fewer than 64 open files "
        "are allowed. "
        "Start with: resonatord demo",
    )
    hidden = argparse.SUPPRESS  # no argument of a command
    parser.add_argument(
        "--version", action=_PrintVersion, nargs=0, dest=hidden, default=hidden, help="print the version and exit"
    )
    _add_commands(parser, commands, words)
    return parser


def command_names(package: ModuleType | None = None) -> Iterator[str]:
    """Yield the names of all commands, as `plan codes`; all are imported."""
    for name, module in _modules(package or commands, ()):
        yield from (name,) if _is_command(module) else (f"{name} {sub}" for sub in command_names(module))


def parsers(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield program name and parser of a command and of all that it contains."""
    yield parser.prog, parser
    for action in parser._actions:  # noqa: SLF001 - argparse has no other way to list arguments
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            for sub in action.choices.values():
                yield from parsers(sub)


def _modules(package: ModuleType, words: Sequence[str]) -> Iterator[tuple[str, ModuleType]]:
    """Yield the command that `words` begin with, or all where they name none: of the package, and of extensions."""
    folder = package.__path__[0]
    own = {
        file.removesuffix(".py").replace("_", "-")
        for file in os.listdir(folder)  # pkgutil costs 10 ms more
        if file[0] not in "._" and (file.endswith(".py") or os.path.exists(f"{folder}/{file}/__init__.py"))
    }
    group = getattr(package, "ENTRY_POINTS", None)
    names = own if group is None or own.intersection(words[:1]) else own.union(entry_names(group))
    for name in names.intersection(words[:1]) or sorted(names):
        if name in own:
            yield name, importlib.import_module(f"{package.__name__}.{name.replace('-', '_')}")
        elif group is not None and (module := load_entry(group, name, _has_commands)) is not None:
            yield name, module


def _has_commands(module: ModuleType) -> bool:
    """Return whether a module of an extension is a command or a package of commands; AttributeError if no package."""
    return _is_command(module) or all(_has_commands(command) for _, command in _modules(module, ()))


def _is_command(module: ModuleType) -> bool:
    return hasattr(module, "add_arguments") and hasattr(module, "run")


def _add_commands(parser: argparse.ArgumentParser, package: ModuleType, words: Sequence[str], group: str = "") -> None:
    sub_parsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, module in list(_modules(package, words)) or _modules(package, ()):  # the one named cannot be loaded
        summary, *paragraphs = (module.__doc__ or name).strip().split("\n\n")
        sub = sub_parsers.add_parser(
            name,
            help=summary[0].lower() + summary[1:].removesuffix("."),
            description=" ".join([summary, *paragraphs[:-1]]),
            epilog=paragraphs[-1] if paragraphs else None,
        )
        if _is_command(module):
            module.add_arguments(sub)
            sub.set_defaults(command=group + name, run=module.run)
        else:
            _add_commands(sub, module, words[1:], f"{name} ")


class _PrintVersion(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from importlib.metadata import version  # slow to import

        sys.stdout.write(f"resonatord {version('resonatord')}\n")
        sys.stdout.flush()
        parser.exit()


class _Formatter(argparse.HelpFormatter):
    """Formatter of help whose pages of the documentation are paths on this computer."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return super()._fill_text(with_pages(text), width, indent)

    def _split_lines(self, text: str, width: int) -> list[str]:
        return super()._split_lines(with_pages(text), width)


class _Parser(argparse.ArgumentParser):
    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=_Formatter, allow_abbrev=False, **options)
        self._as_json = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, with an error where the command does not have an argument: argparse prints the usage of all."""
        words = list(args or ())
        options = words[: words.index("--")] if "--" in words else words
        self._as_json = "--json" in options
        if not self._subparsers:  # else the options are those of another command
            for option in options:  # first: argparse would take the value of an unknown option for an argument
                self._check_option(option.partition("=")[0])
        namespace, unknown = super().parse_known_args(args, namespace)
        for last in self._get_positional_actions()[-1:]:
            before = getattr(namespace, last.dest, None)
            is_list, is_free = last.nargs == "*", last.nargs == "?" and before == last.default and len(unknown) == 1
            if unknown and (is_list or is_free) and not any(word.startswith("-") for word in unknown):
                try:  # argparse takes none of them after an option
                    late = self._get_values(last, unknown)
                except argparse.ArgumentError as error:
                    self.error(str(error))
                setattr(namespace, last.dest, [*(before or ()), *late] if is_list else late)
                unknown = []
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return namespace, unknown

    def _check_option(self, option: str) -> None:
        if option.startswith("--") and " " not in option and option not in self._option_string_actions:
            from difflib import get_close_matches

            known = [name for name in self._option_string_actions if name != "--help"]
            near = [name for name in known if name.startswith(option)] or get_close_matches(option, known, n=1)
            self.error(f"no such option: {option}{f'; did you mean {near[0]}?' if near else ''}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            from resonator_daemon.base.toml import nearest

            raise argparse.ArgumentError(action, f"got {value!r}; {nearest(str(value), list(action.choices))}")

    def error(self, message: str) -> NoReturn:
        """Print the usage of the command and what is wrong, with `--json` also as an object; exit."""
        if message.startswith(_ONE_OF):  # of argparse, which puts a space between the names
            names = message.removeprefix(_ONE_OF).removesuffix(" is required").split()
            message = f"give {' or '.join(sorted(names, key=lambda name: name.startswith('-')))}"
        _report(self.prog.partition(" ")[2], UsageError(message), as_json=self._as_json)
        self.print_usage(sys.stderr)
        self.exit(ExitCode.USAGE, f"{self.prog}: {coloured('error:', 'red', sys.stderr)} {message}\n")

    def print_help(self, file: Any = None) -> None:
        """Print the help; OSError where it cannot be written, which argparse ignores."""
        if file is None and sys.stdout is not None:
            sys.stdout.write(self.format_help())
            sys.stdout.flush()
        else:
            super().print_help(file)


def _set_up_output() -> None:
    set_up_logging()
    if sys.stdout is None:  # closed by the parent process
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - for as long as the process lives
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # characters that this locale lacks, and paths that are no text
            stream.reconfigure(errors="backslashreplace")


def _discard_output() -> None:
    """Discard unflushed output, so that Python does not retry it at exit."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _report(command: str, error: UserError, *, as_json: bool) -> None:
    """Print an error as one JSON object to stdout where `--json` asks for objects; flush stdout in any case."""
    try:
        if as_json:
            print_failure(command, error)
        sys.stdout.flush()
    except OSError:  # a full disk, or a reader that has left
        _discard_output()


@contextmanager
def _user_errors() -> Iterator[None]:
    """Raise errors of the operating system as errors of the command."""
    try:
        yield
    except BrokenPipeError:
        raise
    except UnicodeEncodeError as error:  # the streams print everything: it is the name of a file
        what = f"{error.object!a} cannot name a file in this locale, whose encoding is {error.encoding}"
        raise ConfigurationError(f"{what}; set LC_ALL=C.UTF-8") from error
    except OSError as error:  # as of a standard output on a full disk
        raise UserError(reason_of(error), code="system", exit_code=ExitCode.FAILED) from error
