"""Pings on their way to a board and back; a replay that begins midway follows the recorded ones."""

from typing import NamedTuple

from firmware_protocol.host import HostSession
from firmware_protocol.layouts import MessageType
from firmware_protocol.packets import Packet, PacketDecoder
from resonator_daemon.board.session.clock import HostTime

_LOST_NS = 5_000_000_000
_NUMBER_BYTES = 8
_NUMBERS = 1 << 32


class Ping(NamedTuple):
    """A ping on its way: what it carries, when it left, and the newest ticks that were known then."""

    number: int
    sent_ns: int
    known_ticks: int


class Pings:
    """The pings of one connection."""

    def __init__(self) -> None:
        self.on_the_way: dict[int, Ping] = {}  # by number
        self._made = 0
        self._followed: PacketDecoder | None = None  # of what the recorded connection sends

    @property
    def follow(self) -> bool:
        """Whether recorded pings are followed, which `sent` reports, instead of making any."""
        return self._followed is not None

    def restart(self) -> None:
        """Discard all, and make pings again: the board has described itself again."""
        self.on_the_way.clear()
        self._made = 0
        self._followed = None

    def make(self, session: HostSession, now_ns: int, newest_ticks: int) -> None:
        """Send a ping, if the board has room for one."""
        if self._followed is not None:
            return
        for lost in [ping for ping in self.on_the_way.values() if now_ns - ping.sent_ns > _LOST_NS]:
            del self.on_the_way[lost.number]
        if session.ping(self._made.to_bytes(_NUMBER_BYTES, "little")):
            self.on_the_way[self._made] = Ping(self._made, now_ns, newest_ticks)
            self._made += 1

    def answered(self, opaque: bytes) -> Ping | None:
        """Return the ping that is answered; None if it is not on its way."""
        ping = self.on_the_way.pop(int.from_bytes(opaque, "little"), None)
        if ping is not None:
            for before in [other for other in self.on_the_way.values() if other.sent_ns < ping.sent_ns]:
                del self.on_the_way[before.number]  # boards answer in order: it will not be answered any more
        return ping

    def snapshot(self) -> tuple[Ping, ...]:
        """Return those on their way."""
        return tuple(self.on_the_way.values())

    def restore(self, on_the_way: tuple[Ping, ...]) -> None:
        """Set those on their way; from here on `sent` reports the pings, none are made."""
        self._followed = PacketDecoder(from_board=False)
        self.on_the_way = {ping.number: ping for ping in on_the_way}

    def sent(self, session: HostSession, data: bytes, now: HostTime, newest_ticks: int) -> None:
        """Follow what the recorded connection has sent, and its request numbers with it."""
        if self._followed is None:
            return
        session.data_to_send()  # the same, but for the pings
        for packet in self._followed.feed(data):
            if not isinstance(packet, Packet):
                continue
            if (packet.sequence - session.number) % _NUMBERS < _NUMBERS // 2:  # else it was sent again
                session.number = packet.sequence
            if packet.type == MessageType.PING:
                number = int.from_bytes(packet.payload, "little")
                self.on_the_way[number] = Ping(number, now.monotonic_ns, newest_ticks)
