"""The options of `resonatord calibrate`, and which of them belong to skins and which to force plates."""

import argparse
import math
from pathlib import Path
from typing import Any, Final

from resonator_daemon.errors import ExitCode

_DAYS_MAX: Final = 36_500
_SKIN: Final = {"seconds"}
_FORCE: Final = {
    "sites",
    "masses_grams",
    "mass_std",
    "repeats",
    "hold_s",
    "response",
    "response_hold_s",
    "kelvin",
    "temperatures_kelvin",
    "timeout_s",
    "valid_days",
    "output",
    "accept",
    "accept_staged",
    "abort",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare everything that `calibrate` takes."""
    parser.add_argument(
        "kind",
        nargs="?",
        choices=("force", "skin"),
        default="force",
        help="force: known masses on known sites; skin: the decoder's prior (default: force)",
    )
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="that of the daemon")
    parser.add_argument("--json", action="store_true", help="one JSON object a line on stdout, the last one the result")
    skin = parser.add_argument_group("skin")
    skin.add_argument("--seconds", type=_positive, metavar="S", help="how long, from the first frame (default: 20)")
    loads = parser.add_argument_group("force: loads")
    loads.add_argument("--sites", type=_sites, metavar="ID,ID|all", help="which sites to load (default: all)")
    loads.add_argument(
        "--masses-grams", type=_numbers, metavar="G,G", help="masses at hand, rising (default: 50,200,500)"
    )
    loads.add_argument(
        "--mass-std", type=float, metavar="X", help="how well they are known, relative, 1 sigma (default: 0.001)"
    )
    loads.add_argument("--repeats", type=int, metavar="N", help="how often each site is loaded (default: 1)")
    loads.add_argument("--hold-s", type=float, metavar="S", help="how long each load is captured (default: 3)")
    loads.add_argument(
        "--response",
        action="store_true",
        default=None,
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
        "--timeout-s", type=_positive, metavar="S", help="how long a step may take beside its hold (default: 300)"
    )
    result = parser.add_argument_group("force: result")
    result.add_argument("--valid-days", type=_days, metavar="N", help="until the calibration expires (default: 365)")
    result.add_argument("--output", type=Path, metavar="FILE", help="new plate file (default: change the plate's own)")
    ends = result.add_mutually_exclusive_group()
    ends.add_argument("--accept", action="store_true", default=None, help="accept a result without asking")
    ends.add_argument(
        "--accept-staged", action="store_true", default=None, help="accept the result of an earlier calibration"
    )
    ends.add_argument("--abort", action="store_true", default=None, help="forget the result of an earlier calibration")
    parser.set_defaults(refuse=parser.error)


def calibrate_as_asked(options: argparse.Namespace) -> ExitCode:
    """Run what the options ask for."""
    for name in _FORCE if options.kind == "skin" else _SKIN:
        if getattr(options, name) is not None:
            options.refuse(f"--{name.replace('_', '-')} does not belong to: calibrate {options.kind}")
    if options.kind == "skin":
        from resonator_daemon.calibration.skin import calibrate_skin

        return calibrate_skin(options.config, _given(options, seconds=20.0)["seconds"], as_json=options.json)

    from resonator_daemon.calibration.run import Ending, abort_staged, accept_staged, calibrate
    from resonator_daemon.calibration.steps import Wanted

    if options.accept_staged:
        return accept_staged(options.config, as_json=options.json)
    if options.abort:
        return abort_staged(options.config, as_json=options.json)
    usual = Wanted()
    given = _given(
        options,
        sites=usual.sites,
        mass_std=usual.mass_std,
        repeats=usual.repeats,
        hold_s=usual.hold_s,
        response=usual.response,
        response_hold_s=usual.response_hold_s,
        kelvin=usual.kelvin,
        temperatures_kelvin=usual.temperatures_kelvin,
    )
    if options.masses_grams is not None:
        given["masses_kg"] = tuple(gram * 1e-3 for gram in options.masses_grams)
    ending = Ending(
        output=options.output,
        as_json=options.json,
        **_given(options, accept=False, valid_days=365, timeout_s=300.0),
    )
    return calibrate(options.config, Wanted(**given), ending)


def _given(options: argparse.Namespace, **defaults: Any) -> dict[str, Any]:
    """Return the options, defaults where they were not given."""
    values = {name: getattr(options, name) for name in defaults}
    return {name: defaults[name] if value is None else value for name, value in values.items()}


def _numbers(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number, or several with commas between them")
    return values


def _sites(text: str) -> tuple[int, ...]:
    if text == "all":
        return ()
    parts = text.split(",")
    if not all(part.strip().isascii() and part.strip().isdecimal() and len(part) < 10 for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is neither ids of sites with commas between them, as 1,7, nor all")
    return tuple(int(part) for part in parts)


def _days(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 6 and 0 < int(text) <= _DAYS_MAX):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {_DAYS_MAX}")
    return int(text)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0 and below 1e9")
    return value
