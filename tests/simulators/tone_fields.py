"""Records of channelised plates as arrays."""

import numpy as np

from firmware_protocol.layouts import TONE_FIELDS
from resonator_daemon.base.arrays import Floats
from simulators.plate import EmulatedPlate, record_type

RECORD = record_type(TONE_FIELDS)


def counted_fields(plate: EmulatedPlate, frames: int, at_s: float, gate_ticks: int) -> dict[str, Floats]:
    """Count frames from a time of the scenario; return each field (frames, channels, tones)."""
    counted = plate.count(0, round(at_s * 250e6), gate_ticks, frames)
    rows = np.array([[np.frombuffer(channel, RECORD) for channel in frame.channels] for frame in counted])
    return {name: rows[name].astype(np.float64) for name in RECORD.names or ()}
