"""`resonatord identify`: asks the board on a link who it is and what it can do, and leaves it as it was."""

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from firmware_protocol.layouts import PROTOCOL_MAJOR, PROTOCOL_MINOR, Capability
from firmware_protocol.messages import CounterKind, Description, ResetCause
from resonator_daemon.config import LinkTarget, load_config
from resonator_daemon.errors import ExitCode, UserError, failure_told
from resonator_daemon.links.link import LinkUnavailableError
from resonator_daemon.links.opening import open_link
from resonator_daemon.session.compatibility import incompatibilities
from resonator_daemon.session.probe import NoBoardError, ProbeResult, probe, round_trip_s

_KINDS = {int(CounterKind.SINGLE_TONE): "single-tone", int(CounterKind.CHANNELISED): "channelised"}
_CAPABILITIES = {Capability.TEMPERATURE: "temperature", Capability.LOCATE: "locate"}


class NoAnswerError(UserError):
    """No board answers on the link."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_board"


def identify(target: LinkTarget | None, config_path: Path | None, *, blink: bool, as_json: bool) -> ExitCode:
    """Ask, and print what the board says; UNAVAILABLE where it cannot serve the configuration that was named.

    Parameters
    ----------
    target
        Where to ask; None: where the configuration says.

    Raises
    ------
    UserError
        The configuration cannot be used, the port cannot be opened, or no board answers.
    ValueError
        Neither was named.
    """
    with failure_told("identify", as_json=as_json):
        config = None if config_path is None else load_config(config_path)
        if target is not None:
            where = target
        elif config is not None:
            where = config.link
        else:
            raise ValueError("identify needs a link or a configuration")
        inquiry = _ask(where, blink=blink)
    problems = incompatibilities(inquiry.described.description, config.plate) if config is not None else ()
    if as_json:
        sys.stdout.write(json.dumps(_as_json(where, inquiry, problems, blink=blink)) + "\n")
    else:
        for name, value in _lines(where, inquiry, blink=blink):
            sys.stdout.write(f"{name:<15}{value}\n")
    for problem in problems:
        sys.stderr.write(f"resonatord: {config_path}: {problem}\n")
    return ExitCode.UNAVAILABLE if problems else ExitCode.DONE


def _ask(target: LinkTarget, *, blink: bool) -> ProbeResult:
    try:
        link = open_link(target)
    except LinkUnavailableError as error:
        raise NoAnswerError(str(error)) from error
    try:
        return probe(link, blink=blink)
    except NoBoardError as error:
        raise NoAnswerError(f"no board answers on {target}: {error}") from error
    finally:
        link.close()


def _as_json(target: LinkTarget, inquiry: ProbeResult, problems: tuple[str, ...], *, blink: bool) -> dict[str, Any]:
    shortest_s, median_s = round_trip_s(inquiry) or (None, None)
    rate = inquiry.tick_rate
    return {
        "verb": "identify",
        "ok": not problems,
        "link": str(target),
        "identity": asdict(inquiry.described.identity),
        "description": asdict(inquiry.described.description),
        "boot_id": inquiry.described.boot_id,
        "counting": inquiry.counting,
        "round_trip_s": {"shortest": shortest_s, "median": median_s, "answers": len(inquiry.round_trips_s)},
        "tick_rate": None if rate is None else {**rate._asdict(), "plausible": rate.plausible},
        "blinks": inquiry.refused_to_blink is None if blink else None,
        "misfits": problems,
    }


def _lines(target: LinkTarget, inquiry: ProbeResult, *, blink: bool) -> Iterator[tuple[str, str]]:
    identity, description, boot_id = inquiry.described
    yield "board", f"{identity.product} {identity.serial_number}, firmware {identity.firmware}"
    yield "link", str(target)
    yield (
        "protocol",
        f"{PROTOCOL_MAJOR}.{identity.protocol_minor}; this program speaks {PROTOCOL_MAJOR}.{PROTOCOL_MINOR}",
    )
    yield "made for", f"plate {description.plate}"
    kind = _KINDS.get(description.counter_kind, f"of unknown kind {description.counter_kind}")
    yield "counter", f"{kind}, {description.channels} channels, tones on each: {description.tones}"
    yield "gates", _gates(description)
    yield "reference", f"{description.reference_millihertz / 1e9:g} MHz; {_tick_rate(inquiry)}"
    yield "round trip", _round_trip(inquiry)
    yield "queue", "size not told" if description.queue_bytes is None else f"{description.queue_bytes} bytes"
    yield "credit", f"{identity.credit_bytes} bytes"
    able = [name for bit, name in _CAPABILITIES.items() if description.capabilities & bit]
    yield "capabilities", ", ".join(able) or "none beyond what every board can"
    causes = {int(cause): cause.name.lower().replace("_", " ") for cause in ResetCause}
    yield "last reset", f"{causes.get(identity.reset_cause, f'cause {identity.reset_cause}')}; boot {boot_id:08x}"
    yield "state", "counting, and goes on with it" if inquiry.counting else "quiet"
    if blink:
        refused = inquiry.refused_to_blink
        yield "blink", "look for it now" if refused is None else f"not done: {refused}"


def _gates(description: Description) -> str:
    limits = f"{description.gate_ticks_min} to {description.gate_ticks_max} ticks"
    if description.gate_ticks_step > 1:
        limits += f" in steps of {description.gate_ticks_step}"
    if not description.reference_millihertz or not description.gate_ticks_min:
        return limits
    low_hz, high_hz = (
        description.reference_millihertz / 1e3 / ticks if ticks else 0.0
        for ticks in (description.gate_ticks_max, description.gate_ticks_min)
    )
    return f"{limits}: {low_hz:g} to {high_hz:g} frames/s"


def _tick_rate(inquiry: ProbeResult) -> str:
    rate = inquiry.tick_rate
    if rate is None:
        return "its ticks could not be timed"
    measured = (
        f"ticks come {rate.deviation_ppm:+.0f} ppm off by this host's clock, give or take {rate.uncertainty_ppm:.0f}"
    )
    return measured if rate.plausible else f"{measured}: NOT plausible, forces would be wrong by as much"


def _round_trip(inquiry: ProbeResult) -> str:
    times_s = round_trip_s(inquiry)
    if times_s is None:
        return "no ping was answered"
    shortest_s, median_s = times_s
    answers = len(inquiry.round_trips_s)
    return f"{shortest_s * 1e3:.2f} ms at best, {median_s * 1e3:.2f} ms in the middle of {answers}"
