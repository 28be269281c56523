"""A recording instead of a board: its events are replayed, nothing is opened."""

from dataclasses import dataclass
from typing import Self

from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.links.link import Link, LinkUnavailableError
from resonator_daemon.board.links.target import LinkTarget


@dataclass(frozen=True)
class RecordingTarget(LinkTarget):
    """A recording of a link."""

    scheme = "replay"
    syntax = "replay:FILE"

    path: str

    def __str__(self) -> str:
        return f"replay:{self.path}"

    @classmethod
    def parse(cls, text: str) -> Self:
        path = text.partition(":")[2]
        if not path or "\0" in path:
            raise ValueError("must be replay:FILE, a file that `resonatord record` has written")
        return cls(path)

    @property
    def recording_path(self) -> str:
        return self.path

    def open(self) -> Link:
        raise LinkUnavailableError(
            ReasonCode.NO_BOARD_ANSWERS, f"{self} is a recording: it can be replayed, and no board answers there"
        )
