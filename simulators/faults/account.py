"""What was done to the bytes and to the board."""

from dataclasses import dataclass, field, fields


@dataclass(slots=True)
class FaultCounts:
    """What went wrong. What befell packets counts once they have gone out.

    Sequences are those of single-tone frames, each in its run. What is hit is never duplicated.
    """

    bits_flipped: int = 0
    bursts: int = 0
    packets_hit: int = 0  # of any type, that do not arrive as they are
    frames_hit: int = 0  # single-tone frames among them
    parts_hit: int = 0  # parts of channelised frames among them
    frame_sequences_hit: list[int] = field(default_factory=list)
    garbage_bytes: int = 0
    garbage_bursts: int = 0
    packets_duplicated: int = 0
    bytes_duplicated: int = 0
    frame_sequences_duplicated: list[int] = field(default_factory=list)
    chunks_lost: int = 0
    bytes_lost: int = 0
    chunks_reordered: int = 0
    answers_delayed: int = 0
    frames_delayed: int = 0
    frame_sequences_delayed: list[int] = field(default_factory=list)
    frame_sequences_cut: list[int] = field(default_factory=list)  # by a brown-out; not among those hit
    unplugs: int = 0
    renames: int = 0
    freezes: int = 0
    silences: int = 0
    reboots: int = 0
    brown_outs: int = 0
    tick_steps: int = 0
    wrong_boards: int = 0

    def add(self, more: "FaultCounts") -> None:
        for count in fields(self):
            setattr(self, count.name, getattr(self, count.name) + getattr(more, count.name))
