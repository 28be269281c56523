"""Identifies whatever is on a link, without configuring it: a measuring board continues to measure."""

import statistics
import time
from typing import NamedTuple

from firmware_protocol.host import Described, HostEvent, HostSession, Located, PacketRefusal, Pong, Rebooted
from firmware_protocol.layouts import PROTOCOL_MAJOR, PROTOCOL_MINOR
from firmware_protocol.messages import Refusal
from firmware_protocol.packets import ForeignVersion
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.links.link import Link, LinkLostError
from resonator_daemon.board.session.clock import TOLERANCE_PPM, Exchange

ANSWER_S = 3.0
_ASK_AGAIN_S = 0.3
PING_S = 0.05
_PINGS = 20
_POLL_S = 0.01


class NoBoardError(Exception):
    """Nothing on the link gives a board's answers; the text has what came instead.

    `is_a_board`: it uses this protocol all the same, in another version or with a refusal. `refused`: what is wrong
    with its packets, None where none was refused. `lost`: why the link was lost meanwhile, None where it was not.
    """

    def __init__(
        self,
        text: str,
        *,
        is_a_board: bool = False,
        refused: PacketRefusal | None = None,
        lost: ReasonCode | None = None,
    ) -> None:
        super().__init__(text)
        self.is_a_board = is_a_board
        self.refused = refused
        self.lost = lost


class TickRate(NamedTuple):
    """How much faster than described a board's ticks come, by the host's clock, and the bound of that figure."""

    deviation_ppm: float
    uncertainty_ppm: float

    @property
    def plausible(self) -> bool:
        """Whether a running daemon might not flag it: it need not be further off than `TOLERANCE_PPM`."""
        return abs(self.deviation_ppm) <= self.uncertainty_ppm + TOLERANCE_PPM


class ProbeResult(NamedTuple):
    """What a board answered; `round_trips_s` in order, `refused_to_blink` None where it was not asked or did."""

    described: Described
    round_trips_s: tuple[float, ...]
    tick_rate: TickRate | None
    counting: bool
    refused_to_blink: str | None


def probe(link: Link, *, blink: bool = False) -> ProbeResult:
    """Identify the board, ask for its limits, and ping it for a second.

    Raises
    ------
    NoBoardError
        No answer within 3 s, an answer in another protocol version, or a link that was lost meanwhile.
    """
    try:
        return _Probe(link, blink=blink).run()
    except LinkLostError as error:
        text = f"the link was lost before the board had answered: {error}"
        raise NoBoardError(text, lost=error.reason.code) from error


def tick_rate(exchanges: list[Exchange], reference_millihertz: int) -> TickRate | None:
    """Return the rate between the quickest exchange of the first half and that of the second; None without both."""
    half = len(exchanges) // 2
    if not half or not reference_millihertz:
        return None
    first, last = (min(part, key=_round_trip_ns) for part in (exchanges[:half], exchanges[half:]))
    elapsed_ns = (last.sent_monotonic_ns + last.received_monotonic_ns) / 2
    elapsed_ns -= (first.sent_monotonic_ns + first.received_monotonic_ns) / 2
    if elapsed_ns <= 0:
        return None
    expected_ticks = elapsed_ns * reference_millihertz / 1e12
    return TickRate(
        ((last.board_ticks - first.board_ticks) / expected_ticks - 1) * 1e6,
        (_round_trip_ns(first) + _round_trip_ns(last)) / 2 / elapsed_ns * 1e6,
    )


def _round_trip_ns(exchange: Exchange) -> int:
    return exchange.received_monotonic_ns - exchange.sent_monotonic_ns


class _Probe:
    def __init__(self, link: Link, *, blink: bool) -> None:
        self._link = link
        self._session = HostSession()
        self._described: Described | None = None
        self._exchanges: list[Exchange] = []
        self._sent: tuple[bytes, int] | None = None
        self._pings = 0
        self._blink = blink
        self._blink_answered = not blink
        self._refused_to_blink: str | None = None

    def run(self) -> ProbeResult:
        begun = time.monotonic()
        last_sent, next_ping = begun, begun
        while self._described is None or self._pings < _PINGS or not self._blink_answered:
            now = time.monotonic()
            if self._described is None and now - begun > ANSWER_S:
                raise self._no_board()
            if self._described is not None and now - begun > 2 * ANSWER_S:
                break  # the board is identified; the rest was not answered in time
            if self._described is not None and now >= next_ping and self._pings < _PINGS:
                opaque, sent_ns = self._pings.to_bytes(8, "little"), time.monotonic_ns()
                self._pings += 1
                if self._session.ping(opaque):
                    self._sent = (opaque, sent_ns)
                next_ping = now + PING_S
            if self._session.awaits_answer and now - last_sent > _ASK_AGAIN_S:
                self._session.ask_again()
                if self._described is not None and not self._blink_answered:
                    self._session.locate()
            if data := self._session.data_to_send():
                self._link.write(data)
                last_sent = now
            received = self._link.read(_POLL_S)
            received_ns = time.monotonic_ns()
            for event in self._session.receive(received):
                self._handle(event, received_ns)
        if self._described is None:
            raise self._no_board()
        return ProbeResult(
            self._described,
            tuple(_round_trip_ns(exchange) * 1e-9 for exchange in self._exchanges),
            tick_rate(self._exchanges, self._described.description.reference_millihertz),
            counting=self._session.messages.frames_outside_run > 0,  # that this session did not start
            refused_to_blink=self._refused_to_blink if self._blink_answered else "it does not answer",
        )

    def _handle(self, event: HostEvent, received_ns: int) -> None:
        match event:
            case Described():
                self._described = event
                if self._blink:
                    self._session.locate()
            case Pong():
                if self._sent is not None and self._sent[0] == event.opaque:
                    self._exchanges.append(Exchange(self._sent[1], event.board_ticks, received_ns))
            case Located():
                self._blink_answered = True
                self._refused_to_blink = event.refusal.text if event.refusal else None
            case Rebooted():
                self._described = None
                self._exchanges.clear()
                self._pings = 0
            case ForeignVersion():
                raise NoBoardError(
                    f"the board uses protocol {event.major}, this program uses {PROTOCOL_MAJOR}.{PROTOCOL_MINOR}: "
                    "update the firmware or this program",
                    is_a_board=True,
                )
            case Refusal():
                raise NoBoardError(f"the board refuses to identify itself: {event.text}", is_a_board=True)

    def _no_board(self) -> NoBoardError:
        received = self._session.bytes
        is_a_board = received.accepted > 0 and not received.echo
        return NoBoardError(self._silence(), is_a_board=is_a_board, refused=self._session.most_refused)

    def _silence(self) -> str:
        received = self._session.bytes.received
        if not received:
            return "not a byte came; is the board powered, and is it this port?"
        if self._session.bytes.echo:
            return "only our own requests came back: this is a loop, or a terminal that echoes, and no board"
        if refused := self._session.most_refused:
            return f"its packets are refused ({refused.code}): {refused.text}; update the firmware of the board"
        if self._session.bytes.accepted:
            return f"packets came ({received} bytes) and no identification; restart the board"
        return f"{received} bytes came and no packet among them; is it a board of this kind, and the baud rate right?"


def round_trip_s(result: ProbeResult) -> tuple[float, float] | None:
    """Return the shortest and the median round trip; None where no ping was answered."""
    if not result.round_trips_s:
        return None
    return min(result.round_trips_s), statistics.median(result.round_trips_s)
