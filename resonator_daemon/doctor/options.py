"""The options of `resonatord doctor`."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Final

from resonator_daemon.errors import ExitCode

SECONDS: Final = 10.0


def add_options(
    parser: argparse.ArgumentParser, link: Callable[[str], object], positive: Callable[[str], float]
) -> None:
    """Declare everything that `doctor` takes; `link` and `positive` parse as other verbs do."""
    parser.add_argument(
        "link",
        nargs="?",
        type=link,
        metavar="LINK",
        help="serial:PATH?baud=N, tcp://HOST:PORT or usb:VID:PID?serial=S (default: the configuration's)",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="names plate, link, broker and directories")
    parser.add_argument(
        "--seconds",
        type=positive,
        default=SECONDS,
        metavar="N",
        help=f"how long to listen to the board, from its first frame on (default: {SECONDS:g})",
    )
    parser.add_argument(
        "--broker",
        action="append",
        default=[],
        type=_broker,
        metavar="URL",
        help="look at this broker, too: mqtt://host:port; repeat it for several",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")
    parser.set_defaults(refuse=parser.error)


def doctor_as_asked(options: argparse.Namespace) -> ExitCode:
    """Look at what the command line names."""
    from resonator_daemon.doctor.run import DoctorOptions, doctor

    if options.link is None and options.config is None and not options.broker:
        options.refuse("name a --config FILE, a LINK (see: resonatord ports) or a --broker URL")
    return doctor(DoctorOptions(options.config, options.link, options.seconds, tuple(options.broker), options.json))


def _broker(url: str) -> object:
    from resonator_daemon.errors import UserError
    from resonator_daemon.view.watch import broker_at

    try:
        return broker_at(url, "resonator")
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("--url: ")) from None
