"""The command `resonatord`: its verbs, their options, and the exit code of each."""

import argparse
import asyncio
import io
import json
import logging
import os
import shutil
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

from resonator_daemon.commands.arguments import Verb, make_parser
from resonator_daemon.errors import ExitCode, InterruptedCommandError, UserError, failure_told
from resonator_daemon.host.journal import error_prefix, set_up_logging
from resonator_daemon.host.printable import printable


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; return the exit code."""
    try:
        options = make_parser(_VERBS).parse_args(arguments)  # which may print help and end
        _set_up_output()
        return _run_verb(options)
    except UserError as error:
        for message in error.messages:
            sys.stderr.write(f"{error_prefix()}resonatord: {printable(message)}\n")
        return error.exit_code
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output left: nobody is there to tell
        return ExitCode.FAILED
    except UnicodeEncodeError as error:  # streams take everything: it is the name of a file
        what = f"{error.object!a} cannot name a file in this locale, whose encoding is {error.encoding}"
        sys.stderr.write(f"{error_prefix()}resonatord: {what}; set LC_ALL=C.UTF-8\n")
        return ExitCode.CONFIG
    except OSError as error:  # as where stdout is on a full disk
        where = "" if error.filename is None else f"{error.filename}: "
        sys.stderr.write(f"resonatord: {printable(f'{where}{error.strerror or error}')}\n")
        _drop_output()
        return ExitCode.FAILED


def _drop_output() -> None:
    """Have what could not be printed not be tried once more: Python would end with a code of its own."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _set_up_output() -> None:
    set_up_logging()
    if sys.stdout is None:  # closed by whoever started us
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - for as long as the process lives
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a sign that this locale has not, and paths that are no text
            stream.reconfigure(errors="backslashreplace")


def _run_verb(options: argparse.Namespace) -> ExitCode:
    """Run the verb; Ctrl-C ends well only what runs until it is stopped."""
    verb: Verb = options.verb
    try:
        code = verb(options) or ExitCode.DONE
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        if verb in _UNTIL_STOPPED or (verb is _status and options.watch):
            return ExitCode.DONE
        name = next(name for name, function in _VERBS.items() if function is verb)
        with failure_told(name, as_json=options.json):
            raise InterruptedCommandError("interrupted") from None


def _run(options: argparse.Namespace) -> None:
    from resonator_daemon.daemon.config_store import ConfigStore
    from resonator_daemon.daemon.daemon import serve
    from resonator_daemon.host.places import state_directory

    asyncio.run(serve(ConfigStore(options.config, state_directory() / "last-good")))


def _check(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.config.decoder import is_decoders_own, load_decoder_config
    from resonator_daemon.daemon.config_store import load_checked

    findings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    try:
        if is_decoders_own(options.file):
            notes = load_decoder_config(options.file).mqtt.notes
        else:
            notes = load_checked(options.file).notes
    except UserError as error:
        findings = error.messages
    if options.json:
        _print_json(
            {"verb": "check", "file": str(options.file), "ok": not findings, "errors": findings, "notes": notes}
        )
    else:
        for line in findings:
            sys.stderr.write(f"resonatord: {printable(line)}\n")
        for line in notes:
            sys.stderr.write(f"note: {printable(line)}\n")
        if not findings:
            sys.stderr.write(f"{options.file}: no errors\n")
    return ExitCode.CONFIG if findings else ExitCode.DONE


def _config_example(options: argparse.Namespace) -> None:
    from resonator_daemon.config import example_config

    text = example_config()
    if options.json:
        _print_json({"verb": "config example", "example": text})
    else:
        sys.stdout.write(text)


def _config_schema(options: argparse.Namespace) -> None:
    from resonator_daemon.config.help import config_schema

    sys.stdout.write(json.dumps(config_schema(), indent=None if options.json else 2) + "\n")


def _config_explain(options: argparse.Namespace) -> None:
    from resonator_daemon.config.help import UnknownKeyError, explained, explanation, key_list

    try:
        keys = explained(options.key)
    except UnknownKeyError as error:
        options.refuse(str(error))
    if options.json:
        _print_json({"verb": "config explain", "keys": [key._asdict() for key in keys]})
    else:
        columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        told = "\n".join(explanation(key, columns) for key in keys) if options.key else key_list(keys, columns)
        sys.stdout.write(told)


def _emulate(options: argparse.Namespace) -> None:
    from simulators.emulator import EmulatorOptions, run
    from simulators.faults import parse_faults

    try:
        run(
            EmulatorOptions(
                plate=options.plate,
                pty=options.pty,
                tcp=options.tcp,
                usb=options.usb,
                scenario=options.scenario,
                truth=options.truth,
                faults=parse_faults(options.faults),
                counter=options.counter,
                seed=options.seed,
                speed=options.speed,
                frame_rate_hz=options.frame_rate_hz,
                json=options.json,
            )
        )
    except ValueError as error:
        raise UserError(*str(error).split("\n")) from error  # a line for each mistake
    except OSError as error:
        raise UserError(str(error)) from error


def _ports(options: argparse.Namespace) -> None:
    from resonator_daemon.ports import list_places

    list_places(as_json=options.json)


def _identify(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.identify import identify

    if options.link is None and options.config is None:
        options.refuse("name a LINK (see: resonatord ports) or --config FILE")
    return identify(options.link, options.config, blink=options.blink, as_json=options.json)


def _doctor(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.doctor.options import doctor_as_asked

    logging.getLogger().setLevel(logging.ERROR)  # what matters of it is in the report
    return doctor_as_asked(options)


def _record(options: argparse.Namespace) -> None:
    from resonator_daemon.record import RecordOptions, record

    wanted = RecordOptions(options.output, options.seconds, options.max_mb, options.max_minutes, options.derived)
    record(options.config, wanted, as_json=options.json)


def _export(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.exporting.run import export_as_asked

    return export_as_asked(options)


def _repair(options: argparse.Namespace) -> None:
    from resonator_daemon.repair import repair

    repair(options.file, options.output, as_json=options.json)


def _replay(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.replay.run import replay_as_asked

    logging.getLogger().setLevel(logging.WARNING)  # that a broker is connected goes without saying
    return replay_as_asked(options)


def _watch(options: argparse.Namespace) -> None:
    from resonator_daemon.config import load_client
    from resonator_daemon.view.watch import broker_at, watch

    broker = load_client(options.config).mqtt if options.config else broker_at(options.url, options.prefix)
    asyncio.run(watch(broker, as_json=options.json, full_rate=options.full_rate))


def _demo(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.demo import DemoOptions, run_demo

    logging.getLogger().setLevel(logging.ERROR)  # what matters of it is in the view and in the result
    plates = tuple(options.plate or ("quartz16", "skin32"))
    headless = options.headless or options.json or not sys.stdout.isatty()
    return run_demo(DemoOptions(plates, options.seconds, headless=headless, json=options.json))


def _plan_sensors(options: argparse.Namespace) -> None:
    from rich.console import Console

    from resonator_daemon.elastic.half_space import HalfSpace
    from resonator_daemon.elastic.sensor_resolution import SensorArray
    from resonator_daemon.elastic.sensor_sets import SensorSet
    from resonator_daemon.view.sensor_plan import SensorPlan

    logging.getLogger().setLevel(logging.WARNING)  # matplotlib tells of its fonts
    try:
        skin = HalfSpace(options.youngs_modulus_pascal, options.poisson_ratio)
        sensors = SensorSet(skin, tuple(name.strip() for name in options.set.split(",")), 1e-3 * options.depth_mm)
        plan = SensorPlan(SensorArray(sensors, 1e-3 * options.pitch_mm, options.snr_db))
    except ValueError as error:
        options.refuse(str(error))
    if options.picture is not None:
        plan.write_picture(options.picture)
    if options.json:
        _print_json(plan.as_json())
    else:
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="replace")  # where the terminal has no sign for a degree
        Console(highlight=False).print(plan)


def _plan_codes(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.planning.run import plan_codes_as_asked

    logging.getLogger().setLevel(logging.WARNING)  # matplotlib tells of its fonts
    return plan_codes_as_asked(options)


def _calibrate(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.calibration.options import calibrate_as_asked

    return calibrate_as_asked(options)


def _status(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.status_verb import status

    return status(options.name, watch=options.watch, as_json=options.json)


def _tare(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.tare import tare

    logging.getLogger().setLevel(logging.WARNING)  # that a broker is connected goes without saying
    return tare(options.config, as_json=options.json)


def _install(options: argparse.Namespace) -> None:
    from resonator_daemon.install import install

    install(options.prefix, dry_run=options.dry_run, as_json=options.json)


def _schema(options: argparse.Namespace) -> None:
    from resonator_daemon.schema import print_schema

    print_schema(as_json=options.json)


def _decode(options: argparse.Namespace) -> None:
    from resonator_daemon.config.decoder import load_decoder_config
    from resonator_daemon.remote_decoding.service import serve

    asyncio.run(serve(load_decoder_config(options.config)))


def _bench_latency(options: argparse.Namespace) -> ExitCode:
    from resonator_daemon.demo.latency import LatencyOptions, bench_latency

    logging.getLogger().setLevel(logging.ERROR)  # what matters of it is in the result
    return bench_latency(
        LatencyOptions(
            plate=options.plate,
            seconds=options.seconds,
            apart=options.apart,
            broker=options.broker,
            json=options.json,
            picture=options.picture,
        )
    )


def _print_json(value: Any) -> None:
    sys.stdout.write(json.dumps(value) + "\n")


_VERBS: dict[str, Verb] = {
    "bench latency": _bench_latency,
    "calibrate": _calibrate,
    "check": _check,
    "config example": _config_example,
    "config explain": _config_explain,
    "config schema": _config_schema,
    "decode": _decode,
    "demo": _demo,
    "doctor": _doctor,
    "emulate": _emulate,
    "export": _export,
    "identify": _identify,
    "install": _install,
    "plan codes": _plan_codes,
    "plan sensors": _plan_sensors,
    "ports": _ports,
    "record": _record,
    "repair": _repair,
    "replay": _replay,
    "run": _run,
    "schema": _schema,
    "status": _status,
    "tare": _tare,
    "watch": _watch,
}

_UNTIL_STOPPED: Final = (_decode, _emulate, _run, _watch)
"""Those without an end of their own; `demo` and `record` catch Ctrl-C themselves once they have begun."""
