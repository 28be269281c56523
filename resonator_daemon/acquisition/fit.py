"""Whether a board can serve a plate: what it describes against what the plate file says."""

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT
from firmware_protocol.messages import CounterKind, Description
from resonator_daemon.plate import Plate

_KINDS = {CounterKind.SINGLE_TONE: "single-tone", CounterKind.CHANNELISED: "channelised"}
_REFERENCE_TOLERANCE = 1e-6  # nominal against nominal: both are written down, not measured
_OFFSET_LIMIT_HZ = 32_767.0  # offset_hz16 reaches no further


def gate_ticks(plate: Plate) -> int:
    """Return the gate, in board ticks, that gives the plate's frame rate."""
    return round(plate.counter.reference_hz / plate.counter.frame_rate_hz)


def oscillator_hz(description: Description) -> NDArray[np.float64]:
    """Return the frequency (tones,) against which a channelised board counts each tone."""
    number = np.arange(description.tones, dtype=np.float64)
    return (description.oscillator_millihertz + number * description.oscillator_spacing_millihertz) / 1e3


def misfits(description: Description, plate: Plate) -> tuple[str, ...]:
    """Return a sentence for everything about the board that does not fit the plate file; empty when it fits."""
    reference_hz = description.reference_millihertz / 1e3
    kind = _KINDS.get(CounterKind(description.counter_kind)) if description.counter_kind in set(CounterKind) else None
    pairs: list[tuple[str, object, object]] = [
        ("plate", description.plate, plate.name),
        ("counter kind", kind or f"number {description.counter_kind}", plate.counter.kind),
        ("channels", description.channels, CHANNEL_COUNT),
    ]
    if abs(reference_hz / plate.counter.reference_hz - 1) > _REFERENCE_TOLERANCE:
        pairs.append(("reference_hz", reference_hz, plate.counter.reference_hz))
    if plate.counter.kind == "channelised":
        pairs.append(("tones", description.tones, len(plate.tones.f0_hz)))
    found = [
        f"{what}: the board describes {board}, the plate file has {expected}"
        for what, board, expected in pairs
        if board != expected
    ]
    if found:
        return tuple(found)
    if not description.gate_ticks_min <= gate_ticks(plate) <= description.gate_ticks_max:
        low, high = reference_hz / max(1, description.gate_ticks_max), reference_hz / max(1, description.gate_ticks_min)
        expected_hz = plate.counter.frame_rate_hz
        return (f"frame rate: the board makes {low:g} to {high:g} Hz, the plate file has {expected_hz:g} Hz",)
    if plate.counter.kind == "channelised":
        offset_hz = np.abs(plate.tones.f0_hz - oscillator_hz(description)[:, None])
        worst = int(offset_hz.max(axis=1).argmax())
        if offset_hz[worst].max() > _OFFSET_LIMIT_HZ:
            return (
                f"tone {worst}: the board's oscillator is {offset_hz[worst].max():.0f} Hz from the plate file's f0, "
                f"at most {_OFFSET_LIMIT_HZ:.0f} Hz can be counted",
            )
    return ()
