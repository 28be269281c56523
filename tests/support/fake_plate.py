"""A plate for emulated boards that counts what it is asked to, with a contact and a temperature of its own."""

from typing import Any

from firmware_protocol.layouts import SINGLE_TONE_STRUCT, TONE_STRUCT
from firmware_protocol.messages import CounterKind, Description, Identity
from simulators.board import Board
from simulators.plate import Contact, CountedFrame

CONTACT = Contact(1, None, (0.0, 0.0), (0.0, 0.0, 1.0))
PLATE_KELVIN = 300.0


class FakePlate:
    """Plate whose records are bytes of the channel's number; keeps what it was asked."""

    def __init__(
        self,
        kind: CounterKind = CounterKind.SINGLE_TONE,
        tones: int = 1,
        block_frames: int = 4,
        reference_millihertz: int = 10**9,
    ) -> None:
        self.description = Description(kind, 4, tones, reference_millihertz, 10, reference_millihertz // 1000, "fake")
        self.block_frames = block_frames
        self.starts = 0
        self.asked: list[tuple[int, int, int, int]] = []
        self._record_bytes = SINGLE_TONE_STRUCT.size if tones == 1 else tones * TONE_STRUCT.size

    def start(self) -> None:
        self.starts += 1

    def count(self, board_ticks: int, scenario_ticks: int, gate_ticks: int, frames: int) -> list[CountedFrame]:
        self.asked.append((board_ticks, scenario_ticks, gate_ticks, frames))
        channels = [bytes([channel]) * self._record_bytes for channel in range(4)]
        return [CountedFrame(channels, [CONTACT], PLATE_KELVIN)] * frames


def fake_board(plate: FakePlate | None = None, queue_bytes: int = 10**6, **options: Any) -> Board:
    """Return a board of a fake plate, with boot id 77."""
    identity = Identity("honest", "0042", "1.0", 0, credit_bytes=256)
    return Board(plate or FakePlate(block_frames=1), identity, 77, queue_bytes, **options)
