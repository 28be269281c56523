"""Serve a live page of what plates publish, for a browser, until stopped.

The page is at http://127.0.0.1:8600/ and is for this computer. Other addresses need a token and TLS, as does everything
that other computers can reach: docs/reference/live-page.md has an example.

Example: resonatord view --url mqtt://127.0.0.1:1883
"""

import argparse
import sys
from contextlib import suppress
from pathlib import Path

from resonator_daemon.commands._broker import add_broker, broker_of
from resonator_daemon.commands._output import print_json
from resonator_daemon.errors import ExitCode, UsageError, UserError
from resonator_daemon.host.printable import how_to_install


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_broker(parser)
    parser.add_argument(
        "--listen",
        type=_host_and_port,
        default=("127.0.0.1", 8600),
        metavar="HOST:PORT",
        help="address of the page; port 0 selects a free one (default: 127.0.0.1:8600)",
    )
    parser.add_argument(
        "--token-file", type=Path, metavar="FILE", help="a secret that browsers have to send, on one line"
    )
    parser.add_argument("--tls-certificate", type=Path, metavar="FILE", help="PEM file with the page's certificate")
    parser.add_argument("--tls-key", type=Path, metavar="FILE", help="PEM file with the key of the certificate")
    parser.add_argument(
        "--allow-commands", action="store_true", help="browsers may send tare, mark, start_recording and stop_recording"
    )
    parser.add_argument("--json", action="store_true", help='print {"url": ...} on stdout when the page is there')


def run(arguments: argparse.Namespace) -> ExitCode:
    with suppress(KeyboardInterrupt):
        import asyncio

        try:
            from resonator_daemon.live_page.credentials import read_token, tls_of
            from resonator_daemon.live_page.server import LivePageOptions, serve
        except ModuleNotFoundError as error:
            raise UserError(f"the live page needs {error.name}: {how_to_install('aiohttp')}") from error

        if (arguments.tls_certificate is None) != (arguments.tls_key is None):
            raise UsageError("--tls-certificate and --tls-key go together; give both, or neither")
        host, port = arguments.listen
        options = LivePageOptions(
            broker_of(arguments),
            host,
            port,
            None if arguments.token_file is None else read_token(arguments.token_file),
            None if arguments.tls_key is None else tls_of(arguments.tls_certificate, arguments.tls_key),
            arguments.allow_commands,
        )

        def print_address(url: str) -> None:
            if arguments.json:
                print_json({"url": url})
            else:
                sys.stdout.write(f"live page: {url}\nstop with Ctrl-C\n")
            sys.stdout.flush()

        asyncio.run(serve(options, print_address))
    return ExitCode.DONE


def _host_and_port(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT (try 127.0.0.1:8600; port 0 selects a free one)")
    return host.strip("[]"), int(port)
