"""Snapshots of a link, with which a recording can begin during a connection.

Which board counts, the number and time of its last frame, what is known of its clock, and the pings on their way.
"""

from typing import NamedTuple

from firmware_protocol.host import Described
from firmware_protocol.messages import Configuration
from resonator_daemon.base.host.load import HostLoad
from resonator_daemon.board.session.clock import ClockSnapshot
from resonator_daemon.board.session.frame_numbers import NumberingSnapshot
from resonator_daemon.board.session.link_state import LinkStateSnapshot


class Ping(NamedTuple):
    """A ping on its way: what it carries, when it left, and the newest ticks that were known then."""

    number: int
    sent_ns: int
    known_ticks: int


class ConnectionSnapshot(NamedTuple):
    """A connection whose board counts, between two packets and two frames.

    `request_number` is that of the last request, `answered_ns` the monotonic time of the last answer, `rate_doubt` what
    is odd about the board's ticks, `newest_ticks` the newest in any message.
    """

    described: Described
    configuration: Configuration
    request_number: int
    answered_ns: int
    rate_doubt: str | None
    newest_ticks: int
    clock: ClockSnapshot
    pings: tuple[Ping, ...]
    load: HostLoad = HostLoad()  # older recordings have none


class LinkSnapshot(NamedTuple):
    """State of a link; `running` None while it is closed, `known` the board of the connection before."""

    state: LinkStateSnapshot
    numbers: NumberingSnapshot
    known: Described | None
    running: ConnectionSnapshot | None
