"""Calibrate a force plate with known masses, or depth, modulus and gain of a skin with a ball of known weight.

Example: resonatord calibrate left-index.toml --masses-grams 50,200,500 --output left-index-plate.toml
"""

import argparse
from pathlib import Path
from typing import Final

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line import number, options_of, positive, whole_number

_OF_BOTH: Final = {
    *("words", "config", "json", "command", "run", "masses_grams", "mass_std", "timeout_s"),
    *("output", "apply", "accept", "valid_days"),
}
_OF_SKIN: Final = {"ball", "load_newton", "presses"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.argument_default = argparse.SUPPRESS  # options that belong to one quantity are absent unless they are given
    parser.add_argument(
        "words",
        nargs="*",
        type=_quantity_or_config,
        default=[],
        metavar="{force,skin} FILE",
        help="force: known masses on known sites; skin: a ball, put anywhere on a skin (default: force); and the "
        "daemon's configuration, as left-index.toml. A skin needs the running daemon",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="the configuration, likewise")
    parser.add_argument("--json", action="store_true", help="one JSON object a line on stdout, the last one the result")
    skin = parser.add_argument_group("skin")
    skin.add_argument("--ball", type=positive, metavar="MM", help="radius of the ball in mm; its weight is the mass")
    skin.add_argument("--load-newton", type=positive, metavar="N", help="known force on the ball instead of a mass")
    skin.add_argument("--presses", type=whole_number(3, 100), metavar="N", help="how often (default: 6)")
    loads = parser.add_argument_group("loads")
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
    result = parser.add_argument_group("result")
    result.add_argument(
        "--valid-days", type=whole_number(1, 36_500), metavar="N", help="until the calibration expires (default: 365)"
    )
    result.add_argument("--output", type=Path, metavar="FILE", help="new plate file (default: change the plate's own)")
    result.add_argument("--apply", action="store_true", help="set `plate` in the configuration to the file of --output")
    result.add_argument("--accept", action="store_true", help="change the plate's own file without asking")


def run(arguments: argparse.Namespace) -> ExitCode:
    given = vars(arguments).keys() - _OF_BOTH
    quantity, config = _chosen(arguments)
    foreign = given - _OF_SKIN if quantity == "skin" else given & _OF_SKIN
    for name in foreign:
        raise UsageError(f"--{name.replace('_', '-')} does not belong to: calibrate {quantity}")
    from resonator_daemon.tools.calibration.run import Ending, calibrate
    from resonator_daemon.tools.calibration.steps import STANDARD_GRAVITY, LoadRequest

    ending = options_of(Ending, arguments, as_json="json" in arguments)
    masses_kg = tuple(gram * 1e-3 for gram in getattr(arguments, "masses_grams", ()))
    if quantity == "skin":
        from resonator_daemon.tools.calibration.skin import BallRequest, calibrate_skin

        loads = [mass_kg * STANDARD_GRAVITY for mass_kg in masses_kg]
        loads += [arguments.load_newton] if "load_newton" in arguments else []
        if "ball" not in arguments or len(loads) != 1:
            raise UsageError("give the radius of the ball with --ball, and one of --masses-grams and --load-newton")
        known = {"force_std": arguments.mass_std} if "mass_std" in arguments else {}
        calibrate_skin(
            config,
            options_of(BallRequest, arguments, ball_radius_m=arguments.ball * 1e-3, force_newton=loads[0], **known),
            ending,
        )
        return ExitCode.DONE
    request = options_of(LoadRequest, arguments, **({"masses_kg": masses_kg} if masses_kg else {}))
    return calibrate(config, request, ending)


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
