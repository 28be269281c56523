"""Compatibility of a board with a plate: its description against the plate file."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.host import Described
from firmware_protocol.layouts import CHANNEL_COUNT
from firmware_protocol.messages import CounterKind, Description
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.frames import BoardRefused

_REFERENCE_TOLERANCE = 1e-6  # nominal against nominal: both are written down, not measured
_GATE_TICKS_LIMIT = 1 << 32  # times within a record have 32 bits
_CODES = {"plate": ReasonCode.WRONG_PLATE, "reference_hz": ReasonCode.WRONG_REFERENCE}
_OFFSET_LIMIT_HZ = 32_767.0  # offset_hz16 reaches no further


class BoardRefusedError(Exception):
    """The board can never serve this plate, or uses another protocol."""

    def __init__(self, problem: Reason, *, other_protocol: bool = False) -> None:
        super().__init__(problem.text)
        self.refused = BoardRefused((problem,), other_protocol)


def gate_ticks(plate: Plate) -> int:
    """Return the gate, in board ticks, that gives the plate's frame rate."""
    return round(plate.counter.reference_hz / plate.counter.frame_rate_hz)


def oscillator_hz(description: Description) -> NDArray[np.float64]:
    """Return the frequency (tones,) against which a channelised board counts each tone; of others nothing."""
    number = np.arange(description.oscillators, dtype=np.float64)
    return (description.oscillator_millihertz + number * description.oscillator_spacing_millihertz) / 1e3


def incompatibilities(description: Description, plate: Plate) -> tuple[Reason, ...]:
    """Return a problem for each property of the board that is incompatible with the plate file."""
    reference_hz = description.reference_millihertz / 1e3
    kinds = {kind.value: kind.name.lower().replace("_", "-") for kind in CounterKind}
    number = description.counter_kind
    pairs: list[tuple[str, object, object]] = [
        ("plate", description.plate, plate.name),
        ("counter kind", kinds.get(number, f"number {number}"), plate.counter.kind),
        ("channels", description.channels, CHANNEL_COUNT),
    ]
    if abs(reference_hz / plate.counter.reference_hz - 1) > _REFERENCE_TOLERANCE:
        pairs.append(("reference_hz", reference_hz, plate.counter.reference_hz))
    if plate.oscillators:
        pairs.append(("tones", description.tones, plate.oscillators))
    found = [
        Reason(
            _CODES.get(what, ReasonCode.WRONG_COUNTER),
            f"{what}: the board describes {board}, the plate file has {expected}",
        )
        for what, board, expected in pairs
        if board != expected
    ]
    if description.plate != plate.name:
        remedy = f'set plate = "{description.plate}", or connect a board of {plate.name}'
        found[0] = Reason(found[0].code, f"{found[0].text}; {remedy}")
    if description.gate_ticks_min > description.gate_ticks_max:
        low, high = description.gate_ticks_min, description.gate_ticks_max
        words = f"gate: the board describes at least {low} and at most {high} ticks, which no gate can be"
        found.append(_gate(words))
    if description.gate_ticks_max >= _GATE_TICKS_LIMIT:
        words = f"gate: the board describes up to {description.gate_ticks_max} ticks, a record has room for 2^32 - 1"
        found.append(_gate(words))
    if description.gate_ticks_step < 1:
        found.append(_gate("gate: the board describes multiples of 0 ticks, which no gate can be"))
    if found:
        return tuple(found)
    if not description.gate_ticks_min <= gate_ticks(plate) <= description.gate_ticks_max:
        low_hz = reference_hz / max(1, description.gate_ticks_max)
        high_hz = reference_hz / max(1, description.gate_ticks_min)
        expected_hz = plate.counter.frame_rate_hz
        words = f"frame rate: the board makes {low_hz:g} to {high_hz:g} Hz, the plate file has {expected_hz:g} Hz"
        return (_gate(words),)
    if gate_ticks(plate) % description.gate_ticks_step:
        words = (
            f"frame rate: the board makes gates of multiples of {description.gate_ticks_step} ticks, the plate file's "
            f"{plate.counter.frame_rate_hz:g} Hz need {gate_ticks(plate)}"
        )
        return (_gate(words),)
    if plate.oscillators:
        offset_hz = np.abs(plate.tones.f0_hz - oscillator_hz(description)[:, None])
        worst = int(offset_hz.max(axis=1).argmax())
        if offset_hz[worst].max() > _OFFSET_LIMIT_HZ:
            words = (
                f"tone {worst}: the board's oscillator is {offset_hz[worst].max():.0f} Hz from the plate file's f0, "
                f"at most {_OFFSET_LIMIT_HZ:.0f} Hz can be counted"
            )
            return (Reason(ReasonCode.WRONG_COUNTER, words),)
    return ()


def first_of(problems: Sequence[Reason]) -> Reason:
    """Return the first problem, with the number of the others."""
    code, text = problems[0]
    others = len(problems) - 1
    counted = f" ({others} other difference{'s' if others > 1 else ''})" if others else ""
    return Reason(code, text + counted)


def identity_changes(board: Described, known: Described) -> tuple[Reason, ...]:
    """Return a problem for each difference from the board that was here before; empty when it is the same."""
    if board.identity.serial_number != known.identity.serial_number:
        words = (
            f"another board is on this link: {board.identity.serial_number}; {known.identity.serial_number} was here "
            "before: connect that one again, or restart the daemon to use this one"
        )
        return (Reason(ReasonCode.ANOTHER_BOARD, words),)
    pairs = [("product", board.identity.product, known.identity.product)]
    pairs += [
        (field.name, getattr(board.description, field.name), getattr(known.description, field.name))
        for field in fields(board.description)
    ]
    return tuple(
        Reason(
            ReasonCode.ANOTHER_BOARD,
            f"{name}: the board reports {present}, before it reported {past}; restart the daemon to use it as it is",
        )
        for name, present, past in pairs
        if present != past
    )


def wrong_unit(serial_number: str, unit: str) -> Reason:
    """Return the reason against a board with which the plate was not calibrated."""
    text = (
        f"serial number: the board is {serial_number}, the plate file was calibrated with {unit}; connect that one, "
        "or name the plate file of this one"
    )
    return Reason(ReasonCode.WRONG_SERIAL_NUMBER, text)


def tick_rate_problem(description: Description, slower_ppm: float, uncertainty_ppm: float) -> str:
    """Return a sentence on ticks that do not come at the rate that the board describes."""
    described_hz = description.reference_millihertz / 1e3
    measured_hz = described_hz / (1 + slower_ppm * 1e-6)
    return (
        f"reference_hz: the board describes {described_hz:.0f} Hz, its ticks come at {measured_hz:.0f} Hz "
        f"(give or take {uncertainty_ppm:.0f} ppm by this host's clock)"
    )


def _gate(text: str) -> Reason:
    return Reason(ReasonCode.WRONG_GATE, text)
