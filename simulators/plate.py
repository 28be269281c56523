"""What an emulated plate offers to its board: counted frames, and the truth they were counted from."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from firmware_protocol.layouts import Field
from firmware_protocol.messages import Description
from simulators.arrays import Floats

REFERENCE_ERROR = 1.5e-6  # the board's reference oscillator is that much fast, unless a scenario sets it


class Contact(NamedTuple):
    """One touch as it truly is, averaged over a gate. Radii are None where the plate has no skin to touch."""

    id: int
    site: int | None  # where the touch is exactly on a site
    position_m: tuple[float, float]
    force_newton: tuple[float, float, float]
    radius_m: float | None = None
    stick_radius_m: float | None = None
    friction_coefficient: float | None = None


class CountedFrame(NamedTuple):
    """One gate: the records of each channel, what pressed meanwhile, and how warm the plate was."""

    channels: list[bytes]
    contacts: list[Contact]
    plate_kelvin: float = 298.15  # throughout, of a plate without thermal physics


class EmulatedPlate(Protocol):
    """A plate with its counter."""

    @property
    def description(self) -> Description: ...

    @property
    def block_frames(self) -> int:
        """How many frames are best counted at once."""

    def start(self) -> None:
        """Begin a run: what is counted next continues nothing."""

    def count(self, board_ticks: int, scenario_ticks: int, gate_ticks: int, frames: int) -> list[CountedFrame]:
        """Count the next frames of a run.

        Parameters
        ----------
        board_ticks
            The board's count at the start of the first gate.
        scenario_ticks
            Ticks that had passed by then since the scenario began.
        gate_ticks
            Length of each gate.
        frames
            How many gates, one behind the other.
        """


def gate_middles_s(scenario_ticks: int, gate_ticks: int, frames: int, tick_rate_hz: float) -> Floats:
    """Scenario time (frames,) at the middle of each gate."""
    middles: Floats = (scenario_ticks + (np.arange(frames, dtype=np.float64) + 0.5) * gate_ticks) / tick_rate_hz
    return middles


def record_type(fields: Sequence[Field]) -> np.dtype[np.void]:
    """Return the numpy type of a record of the wire."""
    return np.dtype([(field.name, "<" + field.code) for field in fields])


def corner_levels_db(positions_m: Floats, transducers_m: Floats, random: np.random.Generator) -> Floats:
    """Return the level (n, corners) below full scale at which the corners receive tones from positions (n, 2).

    What reaches a corner spreads over the plate, leaks away and interferes with its own echoes, which scatter the level
    by 4 dB: -50 dB (1 + r/1 mm)^(-1/2) exp(-30 r/m).
    """
    distance_m = np.linalg.norm(positions_m[:, np.newaxis] - transducers_m, axis=-1)
    spread_db = -10.0 * np.log10(1.0 + distance_m / 1e-3) - 20.0 * np.log10(np.e) * 30.0 * distance_m
    levels: Floats = -50.0 + spread_db + random.normal(0.0, 4.0, distance_m.shape)
    return levels


def attenuation_db256(level_db: Floats) -> npt.NDArray[np.uint16]:
    """Level below full scale as the wire carries it, in 1/256 dB."""
    return np.clip(np.rint(level_db * -256.0), 0, 0xFFFF).astype(np.uint16)
