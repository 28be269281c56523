"""Calibrate a force plate with known masses, or the decoder's prior to a skin.

Example: resonatord calibrate left-index.toml --masses-grams 50,200,500 --output left-index-plate.toml
"""

import argparse
from pathlib import Path
from typing import Final

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line import number, options_of, positive, whole_number

_OF_BOTH: Final = {"words", "config", "json", "command", "run"}
_OF_SKIN: Final = {"seconds"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.argument_default = argparse.SUPPRESS  # options that belong to one quantity are absent unless they are given
    parser.add_argument(
        "words",
        nargs="*",
        type=_quantity_or_config,
        default=[],
        metavar="{force,skin} FILE",
        help="force: known masses on known sites; skin: the decoder's prior (default: force); and the daemon's "
        "configuration, as left-index.toml",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="the configuration, likewise")
    parser.add_argument("--json", action="store_true", help="one JSON object a line on stdout, the last one the result")
    skin = parser.add_argument_group("skin")
    skin.add_argument("--seconds", type=positive, metavar="S", help="how long, from the first frame (default: 20)")
    loads = parser.add_argument_group("force: loads")
    loads.add_argument("--sites", type=_sites, metavar="ID,ID|all", help="which sites to load (default: all)")
    loads.add_argument(
        "--masses-grams",
        type=_numbers,
        metavar="G,G",
        help="masses at hand, rising (default: 50,200,500)",
    )
    loads.add_argument(
        "--mass-std", type=float, metavar="X", help="how well they are known, relative, 1 sigma (default: 0.001)"
    )
    loads.add_argument("--repeats", type=int, metavar="N", help="how often each site is loaded (default: 1)")
    loads.add_argument("--hold-s", type=float, metavar="S", help="how long each load is captured (default: 3)")
    loads.add_argument(
        "--response",
        action="store_true",
        help="load and unload each site in steps, without releasing it, and fit hysteresis and creep",
    )
    loads.add_argument(
        "--response-hold-s", type=float, metavar="S", help="how long each of those steps is captured (default: 60)"
    )
    loads.add_argument("--kelvin", type=float, metavar="T", help="temperature of the plate, from a thermometer")
    loads.add_argument(
        "--temperatures-kelvin",
        type=_numbers,
        metavar="T,T",
        help="then bring the plate to these and load each site with the heaviest mass",
    )
    loads.add_argument(
        "--timeout-s",
        type=positive,
        metavar="S",
        help="how long a step may take in addition to its hold (default: 300)",
    )
    result = parser.add_argument_group("force: result")
    result.add_argument(
        "--valid-days", type=whole_number(1, 36_500), metavar="N", help="until the calibration expires (default: 365)"
    )
    result.add_argument("--output", type=Path, metavar="FILE", help="new plate file (default: change the plate's own)")
    result.add_argument("--apply", action="store_true", help="have the configuration name the plate file of --output")
    result.add_argument("--accept", action="store_true", help="change the plate's own file without asking")


def run(arguments: argparse.Namespace) -> ExitCode:
    given = vars(arguments).keys() - _OF_BOTH
    quantity, config = _chosen(arguments)
    foreign = given - _OF_SKIN if quantity == "skin" else given & _OF_SKIN
    for name in foreign:
        raise UsageError(f"--{name.replace('_', '-')} does not belong to: calibrate {quantity}")
    as_json = "json" in arguments
    if quantity == "skin":
        from resonator_daemon.tools.calibration.skin import calibrate_skin

        return calibrate_skin(config, getattr(arguments, "seconds", 20.0), as_json=as_json)
    from resonator_daemon.tools.calibration.run import Ending, calibrate
    from resonator_daemon.tools.calibration.steps import LoadRequest

    masses = {"masses_kg": tuple(gram * 1e-3 for gram in arguments.masses_grams)} if "masses_grams" in arguments else {}
    request = options_of(LoadRequest, arguments, **masses)
    return calibrate(config, request, options_of(Ending, arguments, as_json=as_json))


def _chosen(arguments: argparse.Namespace) -> tuple[str, Path]:
    """Return quantity and configuration; UsageError where there is not one of each at most."""
    quantities = [word for word in arguments.words if isinstance(word, str)]
    configs = [word for word in arguments.words if isinstance(word, Path)]
    configs += [arguments.config] if "config" in arguments else []
    if len(quantities) > 1 or len(configs) != 1:
        raise UsageError("name one configuration FILE, and force or skin at most once")
    return (quantities or ["force"])[0], configs[0]


def _quantity_or_config(text: str) -> str | Path:
    from resonator_daemon.base.toml import nearest

    if text in ("force", "skin"):
        return text
    if text.endswith(".toml"):
        return Path(text)
    raise argparse.ArgumentTypeError(f"got {text!r}; {nearest(text, ('force', 'skin', 'FILE.toml'))}")


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(map(number(-1e9, 1e9), text.split(",")))


def _sites(text: str) -> tuple[int, ...]:
    return () if text == "all" else tuple(map(whole_number(0, 10**9), text.replace(" ", "").split(",")))
