"""What `link` in a configuration names: where a board is, and how to open a link to it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self
from urllib.parse import parse_qsl

from resonator_daemon.base.host.text import page
from resonator_daemon.base.toml import nearest
from resonator_daemon.board.links.link import Link
from resonator_daemon.board.links.port_holders import Holder


class UsbId(NamedTuple):
    """A USB device as a link names it; without a serial number the only one of its vendor and product."""

    vendor_id: int
    product_id: int
    serial_number: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundPort:
    """A port that a board may be connected to; what is not known is None."""

    link: str
    kind: str
    device: str
    by_id: str | None = None
    usb_id: str | None = None
    serial_number: str | None = None
    description: str | None = None
    held_by: tuple[Holder, ...]
    held_by_all_seen: bool
    permitted: bool
    looks_like_a_board: bool  # by ids and strings alone: nothing is opened


class LinkTarget(ABC):
    """Base of all carriers' targets; each is a frozen dataclass whose text is the value of `link`.

    Attributes
    ----------
    scheme
        What the text begins with.
    syntax
        The form of the text, for messages.
    is_remote
        Whether the board is on a network: no file of this computer shows who holds it.
    bits_per_s
        What the link carries at most; None where that is not known.
    appears_at
        The file that appears with the board, or the directory in whose tree it does; None where there is none.
    recording_path
        The file of a recording, which is replayed: nothing can be opened, and frames have no age. None for boards.
    serial_port
        The path of a terminal; None for other carriers.
    usb_id
        None for other carriers.
    """

    scheme: ClassVar[str]
    syntax: ClassVar[str]
    is_remote: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def parse(cls, text: str) -> Self:
        """Parse the whole text; the text of a ValueError is what it must be."""

    @abstractmethod
    def open(self) -> Link:
        """Open a link. Raises LinkUnavailableError."""

    def opener(self) -> Callable[[], Link]:
        """Return a function that opens the link any number of times."""
        return self.open

    def same_board(self, other: "LinkTarget") -> bool:
        """Return whether both lead to one board, by whatever name."""
        return self == other

    @classmethod
    def discover(cls) -> list[FoundPort]:
        """Return the ports of this carrier that are present. Raises LinkUnavailableError."""
        return []

    @property
    def bits_per_s(self) -> int | None:
        return None

    @property
    def appears_at(self) -> str | None:
        return None

    @property
    def recording_path(self) -> str | None:
        return None

    @property
    def serial_port(self) -> str | None:
        return None

    @property
    def usb_id(self) -> UsbId | None:
        return None

    @property
    def remedy(self) -> str:
        """What a person does about a link that does not open."""
        return f"see with `resonatord ports` which ports there are, and who holds them; {page('how-to/connect.md')}"


def options_of(query: str, allowed: Sequence[str]) -> dict[str, str]:
    """Return the options behind the question mark of a link; ValueError where one is unknown or given twice."""
    pairs = parse_qsl(query, keep_blank_values=True)
    for position, (key, _) in enumerate(pairs):
        if key not in allowed:
            raise ValueError(f"no option is called {key!r}; {nearest(key, allowed)}")
        if key in (other for other, _ in pairs[:position]):
            raise ValueError(f"{key} is given twice")
    return dict(pairs)
