"""Serve a live page of what plates publish, or of recordings, for a browser, until stopped.

The page is at http://127.0.0.1:8600/ and only for this computer, and it is read-only. Other addresses need a token and
TLS. Recordings are shown instead of a broker, or in addition to that of `--url` or `--config`; those of a directory are
opened from the page. `--press` lets browsers press an emulated plate. docs/reference/live-page.md has examples.

Example: resonatord view --url mqtt://127.0.0.1:1883
"""

import argparse
import os
from functools import partial
from pathlib import Path

from resonator_daemon.base.errors import ExitCode, MissingLibraryError, NoRecordingError, UsageError
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.tools.command_line import add_broker, add_listen, broker_of, named_recordings, print_url


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="*",
        metavar="RECORDING",
        help="one recording, two to compare, or a directory whose recordings browsers may open",
    )
    add_broker(parser)
    add_listen(parser, 8600, "address of the page")
    parser.add_argument(
        "--token-file", type=Path, metavar="FILE", help="a secret that browsers have to send, on one line"
    )
    parser.add_argument("--tls-certificate", type=Path, metavar="FILE", help="PEM file with the page's certificate")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="PEM file with the key of the certificate")
    parser.add_argument(
        "--press",
        type=Path,
        action="append",
        default=[],
        metavar="PATH",
        help="control socket of an emulator whose plate browsers may press; may be repeated",
    )
    parser.add_argument(
        "--allow-commands", action="store_true", help="browsers may send tare, mark, start_recording and stop_recording"
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    import asyncio

    try:
        from resonator_daemon.extensions.live_page.access import read_token, tls_of
        from resonator_daemon.extensions.live_page.hub import Sources
        from resonator_daemon.extensions.live_page.server import LivePage, serve
    except ImportError as error:
        raise MissingLibraryError(f"the live page needs aiohttp: {how_to_install('aiohttp')}") from error

    _check(arguments)
    directory = next((path for path in arguments.recordings if path.is_dir()), None)
    needs_broker = not arguments.recordings or arguments.url or arguments.config
    host, port = arguments.listen
    page = LivePage(
        Sources(
            broker_of(arguments) if needs_broker else None,
            [] if directory else arguments.recordings,
            directory,
            arguments.press,
            arguments.allow_commands,
        ),
        host=host,
        port=port,
        token=None if arguments.token_file is None else read_token(arguments.token_file),
        tls=None if arguments.tls_key is None else tls_of(arguments.tls_certificate, arguments.tls_key),
    )
    asyncio.run(serve(page, partial(print_url, "live page", as_json=arguments.json)))
    return ExitCode.DONE


def _check(arguments: argparse.Namespace) -> None:
    """Raise UserError where arguments contradict each other, or a recording cannot be shown."""
    if (arguments.tls_certificate is None) != (arguments.tls_key is None):
        raise UsageError("--tls-certificate and --tls-key go together; give both, or neither")
    for socket in arguments.press:
        if socket.exists() and not socket.is_socket():
            raise UsageError(f"--press {socket}: is no socket; give the PATH of `resonatord emulate --control`")
    paths = arguments.recordings
    if len(paths) > 2 or (len(paths) == 2 and any(path.is_dir() for path in paths)):
        raise UsageError(f"{len(paths)} paths; name one recording, two to compare, or one directory of recordings")
    if not paths:
        return
    for option in ("prefix", "press", "allow_commands"):
        if getattr(arguments, option) and not (arguments.url or arguments.config):
            raise UsageError(f"--{option.replace('_', '-')} is for plates of a broker; add --url or --config")
    from resonator_daemon.base.errors import meaning_of
    from resonator_daemon.tools.replay.recorded_pipeline import open_replay

    for path in paths:
        try:
            if path.is_dir():
                os.listdir(path)
                continue
            with named_recordings(), open_replay(path):
                pass
        except OSError as error:
            raise NoRecordingError(f"directory {path}: {meaning_of(error)}") from error
