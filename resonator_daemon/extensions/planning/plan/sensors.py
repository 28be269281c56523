"""Print what sensors under a skin resolve of loads on it.

The sensors are a square lattice under an elastic half-space. The output has the resolution of normal and tangential
load, and the bandwidth, symmetry and rank of the signals.

A feature of 1 mm is one stripe of a grating with 1 mm stripes and 1 mm gaps. It is resolved if a best linear estimate
recovers at least half of it. docs/explanation/codes.md explains more.
Example: resonatord plan sensors --set p_n,xz,yz --depth-mm 1 --pitch-mm 0.4 --snr-db 30
"""

import argparse

from resonator_daemon.base.errors import ExitCode, UsageError
from resonator_daemon.tools.command_line import print_json, print_page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set",
        default="p_n,xz,yz",
        metavar="NAMES",
        help="what each sensor measures, by commas: p_n, the mean normal stress; strains xx yy zz xy xz yz, z into the "
        "skin; stresses sigma_xx to sigma_yz (default: %(default)s)",
    )
    for option, default, meaning in (
        ("--depth-mm", 1.0, "of the sensors under the surface"),
        ("--pitch-mm", 0.4, "from sensor to sensor, at most four depths"),
        ("--youngs-modulus-pascal", 2e5, "of the skin"),
    ):
        parser.add_argument(option, type=float, default=default, metavar="X", help=f"{meaning} (default: %(default)g)")
    parser.add_argument(
        "--poisson-ratio", type=float, default=0.5, metavar="X", help="of the skin, 0.5 for rubber (default: 0.5)"
    )
    parser.add_argument(
        "--snr-db",
        type=float,
        default=30.0,
        metavar="X",
        help="20 log10 of the rms of the signals under a load without favoured width over that of the noise, -40 to "
        "100 (default: 30)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, in SI units, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.estimate.elastic.half_space import HalfSpace
    from resonator_daemon.extensions.planning.sensor_array import SensorArray, SensorSet
    from resonator_daemon.extensions.planning.sensor_plan import SensorPlan

    try:
        skin = HalfSpace(arguments.youngs_modulus_pascal, arguments.poisson_ratio)
        names = tuple(name.strip() for name in arguments.set.split(","))
        sensors = SensorSet(skin, names, 1e-3 * arguments.depth_mm)
        plan = SensorPlan(SensorArray(sensors, 1e-3 * arguments.pitch_mm, arguments.snr_db))
    except ValueError as error:
        raise UsageError(str(error)) from error
    if arguments.json:
        print_json(plan.as_json())
    else:
        print_page(plan)
    return ExitCode.DONE
