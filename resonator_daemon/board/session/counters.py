"""Where every byte and every frame of a link went."""

from collections import Counter
from dataclasses import dataclass, field, fields, replace

from firmware_protocol.host import PacketRefusal


@dataclass(frozen=True, slots=True)
class FrameLoss:
    """Frames that did not reach the measurement, by cause."""

    link_gap: int = 0  # never arrived
    damaged: int = 0  # arrived with a wrong checksum, or in pieces
    board_overflow: int = 0  # the board dropped them, and reported it
    host_overrun: int = 0  # the host's driver had no room for their bytes, and reported it
    queue_overflow: int = 0  # arrived, and the frame queue was full

    @property
    def total(self) -> int:
        return self.link_gap + self.damaged + self.board_overflow + self.host_overrun + self.queue_overflow

    def __add__(self, other: "FrameLoss") -> "FrameLoss":
        return FrameLoss(*(getattr(self, cause.name) + getattr(other, cause.name) for cause in fields(self)))

    def within(self, lost: "FrameLoss") -> "FrameLoss":
        """Return this part of `lost` after losses were moved there to `board_overflow`; the sum stays."""
        link_gap, damaged = (
            max(0, min(pair)) for pair in ((self.link_gap, lost.link_gap), (self.damaged, lost.damaged))
        )
        moved = self.link_gap + self.damaged - link_gap - damaged
        return replace(self, link_gap=link_gap, damaged=damaged, board_overflow=self.board_overflow + moved)


@dataclass(slots=True)
class BootCounters:
    """What one boot of a board sent; a gap counts for the boot whose frame ended it."""

    boot_id: int
    connections: int = 0
    frames: int = 0
    lost: FrameLoss = field(default_factory=FrameLoss)  # without queue_overflow: the queue does not distinguish boots
    lost_in_outages: FrameLoss = field(default_factory=FrameLoss)  # of `lost`: what `state/link` reports as outages


BOOTS_REMEMBERED = 8


@dataclass(slots=True)
class LinkCounters:
    """Where every byte and every frame of the link went; complete at any instant.

    bytes_received = bytes_accepted + bytes_other_version + bytes_echo + bytes_discarded + bytes_waiting.
    """

    bytes_received: int = 0
    bytes_accepted: int = 0
    bytes_other_version: int = 0
    bytes_echo: int = 0
    bytes_discarded: int = 0
    bytes_waiting: int = 0
    messages_stale: int = 0
    messages_malformed: int = 0
    messages_unknown: int = 0
    log_lines_dropped: int = 0  # of the board's log, beyond what anyone would read
    frames: int = 0  # handed on or lost to queue_overflow
    parts_lost: int = 0  # of frames that did arrive
    frames_incomplete: int = 0
    connections: int = 0
    host_overruns: int = 0  # reports of the host's driver that it had no room
    clock_outliers: int = 0  # pings that contradicted the others
    clock_restarts: int = 0
    refusals: Counter[PacketRefusal] = field(default_factory=Counter)  # of malformed messages, by reason
    lost: FrameLoss = field(default_factory=FrameLoss)
    boots: list[BootCounters] = field(default_factory=list)  # the latest, the present one last

    def boot(self, boot_id: int) -> BootCounters:
        """Return the counters of the present boot, made where there is none, and now the last."""
        boot = next((boot for boot in self.boots if boot.boot_id == boot_id), BootCounters(boot_id))
        self.boots = [*(other for other in self.boots if other is not boot), boot][-BOOTS_REMEMBERED:]
        return boot

    def copy(self) -> "LinkCounters":
        return replace(self, refusals=self.refusals.copy(), boots=[replace(boot) for boot in self.boots])
