"""Identity and capabilities of a board, as labelled lines and as JSON."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from firmware_protocol.layouts import PROTOCOL_MAJOR, PROTOCOL_MINOR, Capability
from firmware_protocol.messages import CounterKind, Description, ResetCause
from resonator_daemon.base.reasons import Reason
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.probe import ProbeResult, round_trip_s

_KINDS = {int(CounterKind.SINGLE_TONE): "single-tone", int(CounterKind.CHANNELISED): "channelised"}
_CAPABILITIES = {Capability.TEMPERATURE: "temperature", Capability.LOCATE: "locate"}


def as_json(target: LinkTarget, result: ProbeResult, problems: tuple[Reason, ...], *, blink: bool) -> dict[str, Any]:
    """Return the object of `resonatord identify --json`; `problems` is why the board cannot serve a configuration."""
    shortest_s, median_s = round_trip_s(result) or (None, None)
    rate = result.tick_rate
    return {
        "link": str(target),
        "identity": asdict(result.described.identity),
        "description": asdict(result.described.description),
        "boot_id": result.described.boot_id,
        "counting": result.counting,
        "round_trip_s": {"shortest": shortest_s, "median": median_s, "answers": len(result.round_trips_s)},
        "tick_rate": None if rate is None else {**rate._asdict(), "plausible": rate.plausible},
        "blinks": result.refused_to_blink is None if blink else None,
        "misfits": [problem.text for problem in problems],
        "misfit_codes": [problem.code for problem in problems],
    }


def labelled_lines(target: LinkTarget, result: ProbeResult, *, blink: bool) -> Iterator[tuple[str, str]]:
    """Yield label and text of each line of the text output."""
    identity, description, boot_id = result.described
    yield "board", f"{identity.product} {identity.serial_number}, firmware {identity.firmware}"
    yield "link", str(target)
    yield (
        "protocol",
        f"{PROTOCOL_MAJOR}.{identity.protocol_minor}; this program uses {PROTOCOL_MAJOR}.{PROTOCOL_MINOR}",
    )
    yield "made for", f"plate {description.plate}"
    kind = _KINDS.get(description.counter_kind, f"of unknown kind {description.counter_kind}")
    yield "counter", f"{kind}, {description.channels} channels, tones on each: {description.tones}"
    yield "gates", _gates(description)
    yield "reference", f"{description.reference_millihertz / 1e9:g} MHz; {_tick_rate(result)}"
    yield "round trip", _round_trip(result)
    yield "queue", "size not reported" if description.queue_bytes is None else f"{description.queue_bytes} bytes"
    yield "credit", f"{identity.credit_bytes} bytes"
    able = [name for bit, name in _CAPABILITIES.items() if description.capabilities & bit]
    yield "capabilities", ", ".join(able) or "none beyond what every board can"
    causes = {int(cause): cause.name.lower().replace("_", " ") for cause in ResetCause}
    yield "last reset", f"{causes.get(identity.reset_cause, f'cause {identity.reset_cause}')}; boot {boot_id:08x}"
    yield "state", "counting, and goes on with it" if result.counting else "quiet"
    if blink:
        refused = result.refused_to_blink
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


def _tick_rate(result: ProbeResult) -> str:
    rate = result.tick_rate
    if rate is None:
        return "its ticks could not be timed"
    measured = (
        f"ticks come {rate.deviation_ppm:+.0f} ppm off by this host's clock, give or take {rate.uncertainty_ppm:.0f}"
    )
    return measured if rate.plausible else f"{measured}: NOT plausible, forces would be wrong by as much"


def _round_trip(result: ProbeResult) -> str:
    times_s = round_trip_s(result)
    if times_s is None:
        return "no ping was answered"
    shortest_s, median_s = times_s
    answers = len(result.round_trips_s)
    return f"{shortest_s * 1e3:.2f} ms at best, {median_s * 1e3:.2f} ms median of {answers}"
