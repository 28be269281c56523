"""The host's requests: numbered, and sent no faster than the board has room for (PROTOCOL.md, section 5)."""

from collections import deque
from typing import NamedTuple

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import LEAST_CREDIT_BYTES
from firmware_protocol.packets import PACKET_OVERHEAD_BYTES, encode_packet


class Request(NamedTuple):
    """A request under its number."""

    number: int
    type: MessageType
    packet: bytes


class Requests:
    """Numbers requests, sends them while the board has room and keeps the others in order until it has.

    `credit_bytes` is what the packets of unanswered requests may take together, `number` that of the last request,
    `outgoing` the bytes that the board must get now.
    """

    def __init__(self) -> None:
        self.number = 0
        self.outgoing = bytearray()
        self._unanswered: deque[Request] = deque()
        self._unanswered_bytes = 0
        self._waiting: deque[Request] = deque()
        self.credit_bytes = LEAST_CREDIT_BYTES

    @property
    def open(self) -> bool:
        """Whether a request is unanswered or waits to be sent."""
        return bool(self._unanswered or self._waiting)

    def send(self, request_type: MessageType, payload: bytes = b"") -> Request:
        """Send a request as soon as there is room. One of the same type that still waits gives way to it."""
        if self._waiting:
            self._waiting = deque(waiting for waiting in self._waiting if waiting.type is not request_type)
        self.number = (self.number + 1) & 0xFFFFFFFF
        request = Request(self.number, request_type, encode_packet(request_type, self.number, payload))
        self._waiting.append(request)
        self._send_waiting()
        return request

    def has_room(self, payload_bytes: int) -> bool:
        """Return whether a request with that payload would go out at once."""
        packet_bytes = PACKET_OVERHEAD_BYTES + payload_bytes
        return not self._waiting and self._unanswered_bytes + packet_bytes <= self.credit_bytes

    def withdraw(self, request: Request) -> None:
        """Do not send a request any more, if it still waits."""
        if request in self._waiting:
            self._waiting.remove(request)

    def overdue(self, again: Request | None) -> None:
        """Treat all unanswered requests as lost; send `again` once more, before those that wait."""
        self._unanswered.clear()
        self._unanswered_bytes = 0
        if again is not None and again not in self._waiting:
            self._waiting.appendleft(again)
        self._send_waiting()

    def answered(self, number: int) -> MessageType | None:
        """Give back the room of a request and of all before it; return its type, None when it is not unanswered."""
        for answered in self._unanswered:
            if answered.number == number:
                break
        else:
            return None
        done = None
        while done is not answered:
            done = self._unanswered.popleft()
            self._unanswered_bytes -= len(done.packet)
        if self._waiting:
            self._send_waiting()
        return answered.type

    def discard_all(self) -> None:
        """Discard all requests: the board has started anew."""
        self._unanswered.clear()
        self._unanswered_bytes = 0
        self._waiting.clear()
        self.outgoing.clear()
        self.credit_bytes = LEAST_CREDIT_BYTES

    def _send_waiting(self) -> None:
        while self._waiting and self._unanswered_bytes + len(self._waiting[0].packet) <= self.credit_bytes:
            request = self._waiting.popleft()
            self._unanswered.append(request)
            self._unanswered_bytes += len(request.packet)
            self.outgoing += request.packet
