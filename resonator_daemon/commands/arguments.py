"""What the command line takes: the verbs of `resonatord`, their options, and their help."""

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from resonator_daemon.calibration.options import add_options as add_calibrate_options
from resonator_daemon.doctor.options import add_options as add_doctor_options
from resonator_daemon.errors import ExitCode
from resonator_daemon.exporting.options import add_options as add_export_options
from resonator_daemon.planning.options import add_parser as add_plan_codes
from resonator_daemon.replay.options import add_options as add_replay_options

Verb = Callable[[argparse.Namespace], ExitCode | None]


def make_parser(verbs: Mapping[str, Verb]) -> argparse.ArgumentParser:
    """Return the parser; it leaves the function of the verb that was asked for in `verb`."""
    parser = _Parser(
        prog="resonatord",
        description="Acquisition daemon for a quartz-resonator tactile plate: counts to forces, sites, contacts and "
        "surface traction, published over MQTT.",
        epilog="Exit codes: 0 done, or stopped where a verb runs until it is stopped; 1 the run failed (touches or "
        "frames lost) or was interrupted; 2 usage; 69 link or broker cannot ever work; 78 configuration. "
        "Start with: resonatord demo",
    )
    sub_parsers = parser.add_subparsers(title="verbs", required=True, metavar="VERB")

    def add(name: str, summary: str, example: str) -> argparse.ArgumentParser:
        sub = sub_parsers.add_parser(
            name,
            help=summary,
            description=f"{summary[0].upper()}{summary[1:]}.",
            epilog=f"Example: {example}",
        )
        sub.set_defaults(verb=verbs[name])
        return sub

    demo = add(
        "demo",
        "touch emulated plates and show what the daemon makes of it, beside the truth",
        "resonatord demo --plate quartz16 --seconds 20 --json",
    )
    demo.add_argument(
        "--plate",
        action="append",
        metavar="NAME",
        help="quartz16, skin32, fingertip400 or comb16; repeat it for several (default: the first two)",
    )
    demo.add_argument("--seconds", type=_positive, default=60.0, help="how long, from the first frame (default: 60)")
    demo.add_argument("--headless", action="store_true", help="no live view; the default where stdout is no terminal")
    demo.add_argument("--json", action="store_true", help="print one JSON object at the end, and nothing else")

    run = add("run", "measure one board and publish, until stopped", "resonatord run --config left-index.toml")
    run.add_argument("--config", type=Path, required=True, metavar="FILE", help="see: resonatord config example")

    decode = add(
        "decode",
        "decode the signals of skins in a process of its own, anywhere on the network, until stopped",
        "resonatord decode --config left-index.toml",
    )
    decode.add_argument(
        "--config",
        type=Path,
        required=True,
        metavar="FILE",
        help="the daemon's, with `apart = true` in [decoding], or one of [mqtt] and [decoding] alone",
    )

    emulate = add(
        "emulate",
        "stand in for a plate and its board, on a pseudo-terminal, TCP or USB",
        "resonatord emulate --plate quartz16 --pty /tmp/board --truth truth.jsonl",
    )
    emulate.add_argument("--plate", required=True, metavar="NAME|FILE", help="a shipped plate or a plate file")
    link = emulate.add_mutually_exclusive_group(required=True)
    link.add_argument("--pty", type=Path, metavar="LINKPATH", help="symbolic link to keep pointing at the terminal")
    link.add_argument("--tcp", type=_host_and_port, metavar="HOST:PORT", help="where to listen; port 0 picks one")
    link.add_argument(
        "--usb", action="store_true", help="an emulated USB device, for programs started with what is said of it"
    )
    emulate.add_argument("--scenario", metavar="NAME|FILE", help="what touches the plate (default: by plate)")
    emulate.add_argument(
        "--scenario-schema", action=_PrintScenarioSchema, nargs=0, help="print the JSON Schema of scenario files"
    )
    emulate.add_argument("--truth", type=Path, metavar="FILE.jsonl", help="write what is true, a line a frame")
    emulate.add_argument("--faults", default="", metavar="SPEC", help=_faults_help())
    emulate.add_argument(
        "--counter",
        choices=("sums", "stamps"),
        default="sums",
        help="of a single-tone plate: sums in closed form, or of every time stamp, which is slow (default: sums)",
    )
    emulate.add_argument("--seed", type=int, help="of all that is random (default: the scenario's, or 0)")
    emulate.add_argument(
        "--frame-rate-hz",
        type=_positive,
        metavar="HZ",
        help="frames a second that the board offers; the daemon's plate file must have the same in [counter] "
        "(default: the daemon chooses, by its plate file)",
    )
    emulate.add_argument("--speed", type=_positive, default=1.0, metavar="X", help="times real time (default: 1)")
    emulate.add_argument("--json", action="store_true", help="say link and accounts as JSON lines on stdout")

    ports = add("ports", "list what a board may be connected to, and how a configuration names it", "resonatord ports")
    ports.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")

    identify = add(
        "identify",
        "ask the board on a link who it is and what it can do; one that counts goes on counting",
        "resonatord identify serial:/dev/ttyACM0?baud=4000000",
    )
    identify.add_argument(
        "link",
        nargs="?",
        type=_link,
        metavar="LINK",
        help="serial:PATH?baud=N, tcp://HOST:PORT or usb:VID:PID?serial=S; see: resonatord ports (default: the "
        "configuration's)",
    )
    identify.add_argument("--config", type=Path, metavar="FILE", help="also say whether the board can serve it")
    identify.add_argument("--blink", action="store_true", help="have the board make itself seen, where it can")
    identify.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")
    identify.set_defaults(refuse=identify.error)

    doctor = add(
        "doctor",
        "say whether it is the wiring, the sensor or the software, with evidence and what to do",
        "resonatord doctor --config left-index.toml",
    )
    add_doctor_options(doctor, _link, _positive)

    watch = add("watch", "show live what plates publish", "resonatord watch --url mqtt://127.0.0.1:1883")
    where = watch.add_mutually_exclusive_group()
    where.add_argument("--url", default="mqtt://127.0.0.1:1883", help="the broker (default: mqtt://127.0.0.1:1883)")
    where.add_argument("--config", type=Path, metavar="FILE", help="whose [mqtt] names broker, prefix and credentials")
    watch.add_argument("--prefix", default="resonator", help="first level of the topics (default: resonator)")
    watch.add_argument(
        "--full-rate", action="store_true", help="all messages as they come (default: at most 20 or 5 a second of each)"
    )
    watch.add_argument("--json", action="store_true", help="one JSON object a message on stdout")

    install = add(
        "install",
        "put units, udev rules, user and directories of the services into their places",
        "sudo /opt/resonatord/bin/resonatord install",
    )
    install.add_argument("--dry-run", action="store_true", help="say what would be done, and do nothing")
    install.add_argument("--prefix", type=Path, metavar="DIR", help="write below it, and run nothing: for an image")
    install.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")

    schema = add(
        "schema",
        "print the AsyncAPI document of all topics, payloads and commands",
        "resonatord schema > resonatord.asyncapi.json",
    )
    schema.add_argument("--json", action="store_true", help="in one line")

    check = add("check", "check a configuration and its plate file", "resonatord check left-index.toml")
    check.add_argument("file", type=Path, metavar="FILE")
    check.add_argument("--json", action="store_true", help="print the findings as one JSON object")

    calibrate = add(
        "calibrate",
        "calibrate a force plate with known masses, or the decoder's prior to a skin",
        "resonatord calibrate --config left-index.toml --masses-grams 50,200,500 --sites all",
    )
    add_calibrate_options(calibrate)

    status = add("status", "say how the daemons on this computer are", "resonatord status left-index --watch")
    status.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help="that a daemon publishes under, or its configuration's file name without .toml (default: all)",
    )
    status.add_argument("--watch", action="store_true", help="again each second, until interrupted")
    status.add_argument("--json", action="store_true", help="print one JSON object; with --watch one a line")

    tare = add(
        "tare",
        "have the running daemon take the present readings as untouched",
        "resonatord tare --config left-index.toml",
    )
    tare.add_argument("--config", type=Path, required=True, metavar="FILE", help="that of the daemon")
    tare.add_argument("--json", action="store_true", help="print the daemon's answer as one JSON object")

    record = add(
        "record",
        'write what happens on a board\'s link to a file that `link = "replay:FILE"` plays again',
        "resonatord record --config left-index.toml --output run.mcap --seconds 60",
    )
    record.add_argument("--config", type=Path, required=True, metavar="FILE", help="names the plate and the link")
    record.add_argument("--output", type=Path, required=True, metavar="FILE", help="the file to make, as run.mcap")
    record.add_argument(
        "--seconds", type=_positive, metavar="N", help="from the first frame on (default: until interrupted)"
    )
    record.add_argument(
        "--max-mb",
        type=_positive,
        metavar="N",
        help="go from file to file, each of this size, in 10^6 bytes; their names are that of --output and the time",
    )
    record.add_argument("--max-minutes", type=_positive, metavar="N", help="likewise, each of this time")
    record.add_argument(
        "--derived", action="store_true", help="measure, too, and record forces, contacts and states as JSON channels"
    )
    record.add_argument("--json", action="store_true", help="print one JSON object at the end")

    replay = add(
        "replay",
        "play a recording out again, from its bytes to messages, or compare cases with what they expect",
        "resonatord replay run.mcap --speed 4",
    )
    add_replay_options(replay)

    export = add(
        "export",
        "write what follows from a recording as Parquet, CSV, NumPy or MCAP, the latter also for ROS 2",
        "resonatord export run.mcap --output run.parquet",
    )
    add_export_options(export)

    repair = add(
        "repair",
        "copy what is whole of a recording that was cut off or damaged",
        "resonatord repair run.mcap",
    )
    repair.add_argument("file", type=Path, metavar="FILE", help="stays as it is")
    repair.add_argument("--output", type=Path, metavar="FILE", help="the file to make (default: FILE-repaired.mcap)")
    repair.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")

    bench = sub_parsers.add_parser("bench", help="measure this machine with an emulated plate")
    bench_verbs = bench.add_subparsers(title="verbs", required=True, metavar="VERB")
    latency = bench_verbs.add_parser(
        "latency",
        help="from the edge at the board to the subscriber",
        description="Run an emulated plate, the daemon and a broker on this machine, and measure how long it takes "
        "from the last edge that is counted for a message to the subscriber who has it.",
        epilog="docs/latency.md tells more. Example: resonatord bench latency --plate quartz16 --seconds 60",
    )
    latency.add_argument(
        "--plate", choices=("quartz16", "skin32"), default="quartz16", help="forces, or decoded (default: quartz16)"
    )
    latency.add_argument("--seconds", type=_positive, default=600.0, help="how long (default: 600)")
    latency.add_argument("--apart", action="store_true", help="of skin32: with the decoding in a process of its own")
    latency.add_argument("--broker", metavar="URL", help="instead of a Mosquitto of its own, or the embedded broker")
    latency.add_argument("--picture", type=_picture, metavar="FILE", help="also draw to a .svg, .png or .pdf file")
    latency.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")
    latency.set_defaults(verb=verbs["bench latency"])

    plan = sub_parsers.add_parser("plan", help="help with the design of a plate")
    plan_verbs = plan.add_subparsers(title="verbs", required=True, metavar="VERB")
    sensors = plan_verbs.add_parser(
        "sensors",
        help="say what sensors under a skin can and cannot feel",
        description="Say what a square lattice of sensors under a skin can and cannot feel: what it resolves of normal "
        "and tangential load; bandwidth, symmetry and rank of the signals; what pitch and depth would do; a picture "
        "of the signals' power over the plane of spatial frequencies. The skin counts as an elastic half-space.",
        epilog="A feature of 1 mm is one stripe of a grating with 1 mm stripes and 1 mm gaps. It counts as resolved "
        "where a best linear estimate brings back at least half of it. docs/sensors.md tells more. "
        "Example: resonatord plan sensors --set p_n,xz,yz --depth-mm 1 --pitch-mm 0.4 --snr-db 30",
    )
    sensors.add_argument(
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
        sensors.add_argument(option, type=float, default=default, metavar="X", help=f"{meaning} (default: %(default)g)")
    sensors.add_argument(
        "--poisson-ratio", type=float, default=0.5, metavar="X", help="of the skin, 0.5 for rubber (default: 0.5)"
    )
    sensors.add_argument(
        "--snr-db",
        type=float,
        default=30.0,
        metavar="X",
        help="20 log10 of the rms of the signals under a load without favoured width over that of the noise, -40 to "
        "100 (default: 30)",
    )
    sensors.add_argument("--picture", type=_picture, metavar="FILE", help="also draw to a .svg, .png or .pdf file")
    sensors.add_argument("--json", action="store_true", help="print one JSON object, in SI units, and nothing else")
    sensors.set_defaults(verb=verbs["plan sensors"], refuse=sensors.error)

    add_plan_codes(plan_verbs).set_defaults(verb=verbs["plan codes"])

    config = sub_parsers.add_parser("config", help="help with the configuration file")
    config_verbs = config.add_subparsers(title="verbs", required=True, metavar="VERB")
    example = config_verbs.add_parser("example", help="print a configuration to start from")
    example.add_argument("--json", action="store_true", help="print it as a JSON string")
    example.set_defaults(verb=verbs["config example"])
    schema = config_verbs.add_parser("schema", help="print the JSON Schema of the file, for editors")
    schema.add_argument("--json", action="store_true", help="in one line")
    schema.set_defaults(verb=verbs["config schema"])
    explain = config_verbs.add_parser("explain", help="say what a key is, its type, default, range and an example")
    explain.add_argument(
        "key", nargs="?", default="", metavar="KEY", help="as mqtt.url, or mqtt for all of that table (default: a list)"
    )
    explain.add_argument("--json", action="store_true", help="print one JSON object")
    explain.set_defaults(verb=verbs["config explain"], refuse=explain.error)
    return parser


class _Parser(argparse.ArgumentParser):
    def print_help(self, file: Any = None) -> None:
        """Print it; OSError where it cannot be written, of which argparse says nothing."""
        if file is None and sys.stdout is not None:
            sys.stdout.write(self.format_help())
            sys.stdout.flush()
        else:
            super().print_help(file)


class _PrintScenarioSchema(argparse.Action):
    """Like --help: prints and ends, whatever else is given or missing."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from simulators.scenario_schema import scenario_schema

        sys.stdout.write(json.dumps(scenario_schema()) + "\n")
        sys.stdout.flush()
        parser.exit()


def _host_and_port(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT (try 127.0.0.1:0; port 0 picks a free one)")
    return host.strip("[]"), int(port)


def _link(text: str) -> object:
    from resonator_daemon.config import parse_link

    try:
        return parse_link(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: {error}") from error


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0 and below 1e9")
    return value


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix not in (".svg", ".png", ".pdf"):
        raise argparse.ArgumentTypeError(f"{text!r} must end in .svg, .png or .pdf")
    return path


def _faults_help() -> str:
    return (
        "what goes wrong beside the scenario's faults, as bit_error_rate=1e-5,unplug_at_s=10,unplug_for_s=3; "
        "docs/emulator.md lists all"
    )
