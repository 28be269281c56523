"""The host's side of a session: which request comes next and what the board's packets mean (PROTOCOL.md, section 3)."""

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from firmware_protocol.layouts import (
    BLOCK_STRUCT,
    CHANNEL_COUNT,
    SINGLE_TONE_STRUCT,
    TONE_STRUCT,
    Block,
    BlockEncoding,
    MessageType,
    SingleToneRecord,
)
from firmware_protocol.messages import (
    BoardLog,
    BoardStatus,
    Configuration,
    Description,
    Identity,
    MalformedMessageError,
    Refusal,
    decode_message,
    encode_message,
)
from firmware_protocol.packets import Damage, ForeignVersion, Packet, PacketDecoder, encode_packet


class HostState(Enum):
    """Where the host is in the handshake; one row of the table in PROTOCOL.md each."""

    IDENTIFYING = "identifying"
    DESCRIBING = "describing"
    DESCRIBED = "described"
    CONFIGURING = "configuring"
    STARTING = "starting"
    RUNNING = "running"
    REFUSED = "refused"


class Described(NamedTuple):
    """The board said who and what it is; it waits for a configuration."""

    identity: Identity
    description: Description
    boot_id: int


class Started(NamedTuple):
    """Frames count from here, from number 0 unless the board was running already."""

    configuration: Configuration


class Frame(NamedTuple):
    """One gate of a single-tone counter."""

    sequence: int
    board_ticks: int
    size_bytes: int
    records: tuple[SingleToneRecord, ...]


class FramePart(NamedTuple):
    """Some tones of one channel in one gate; `tones` is an array of TONE_FIELDS records as bytes."""

    sequence: int
    board_ticks: int
    size_bytes: int
    block: Block
    tones: bytes


class Pong(NamedTuple):
    """The board's tick count when it received the ping that carried `opaque`."""

    opaque: bytes
    board_ticks: int


class Rebooted(NamedTuple):
    """The board started anew; the session is back at identifying."""

    boot_id: int


HostEvent = (
    Described
    | Started
    | Frame
    | FramePart
    | Pong
    | Rebooted
    | BoardStatus
    | BoardLog
    | Refusal
    | Damage
    | ForeignVersion
)


@dataclass(slots=True)
class MessageCounts:
    """Sound packets that led to nothing, by reason."""

    stale: int = 0  # frames outside a run, answers nobody waits for
    malformed: int = 0
    unknown: int = 0


_ANSWER_TO = {
    MessageType.IDENTITY: MessageType.IDENTIFY,
    MessageType.DESCRIPTION: MessageType.DESCRIBE,
    MessageType.CONFIGURED: MessageType.CONFIGURE,
    MessageType.STARTED: MessageType.START,
}


class HostSession:
    """Bytes from the board in, events out; bytes for the board in `data_to_send`.

    A new session asks the board who it is. After Described, call `configure`; after Started, frames follow.
    The caller has the clock: when an answer is overdue it calls `ask_again`.
    """

    def __init__(self) -> None:
        self._decoder = PacketDecoder(from_board=True)
        self._outgoing = bytearray()
        self._request_number = 0
        self._pending: tuple[MessageType, bytes] | None = None
        self._boot_id = 0
        self._identity: Identity
        self._configuration: Configuration
        self.state = HostState.IDENTIFYING
        self.bytes = self._decoder.counts
        self.messages = MessageCounts()
        self._ask(MessageType.IDENTIFY)

    @property
    def waiting_bytes(self) -> int:
        """Received bytes of a packet that is not complete yet."""
        return self._decoder.waiting_bytes

    def data_to_send(self) -> bytes:
        """Return and clear the bytes that the board must get."""
        data = bytes(self._outgoing)
        self._outgoing.clear()
        return data

    def configure(self, configuration: Configuration) -> None:
        """Choose the gate; the board is started when it has accepted.

        Raises
        ------
        ValueError
            Before the board has described itself.
        """
        if self.state is not HostState.DESCRIBED:
            raise ValueError(f"configure needs a described board, the session is {self.state.value}")
        self.state = HostState.CONFIGURING
        self._ask(MessageType.CONFIGURE, encode_message(configuration))

    def ask_again(self) -> None:
        """Repeat the pending request, if there is one, under its own number."""
        if self._pending is not None:
            self._outgoing += encode_packet(self._pending[0], self._request_number, self._pending[1])

    def ping(self, opaque: bytes) -> None:
        """Ask for the board's tick count; `opaque` (8 bytes) comes back in Pong."""
        # Its number answers nothing: a pong is recognised by what it carries, also while a request is pending.
        self._outgoing += encode_packet(MessageType.PING, 0, opaque)

    def stop(self) -> None:
        """Ask the board to stop counting; nobody waits for the answer."""
        self._outgoing += encode_packet(MessageType.STOP, 0)

    def receive(self, data: bytes) -> list[HostEvent]:
        """Take received bytes and return what they mean, in order."""
        events: list[HostEvent] = []
        for found in self._decoder.feed(data):
            if isinstance(found, Packet):
                try:
                    self._interpret(found, events)
                except MalformedMessageError:
                    self.messages.malformed += 1
            else:
                events.append(found)
        return events

    def _ask(self, request: MessageType, payload: bytes = b"") -> None:
        self._request_number += 1
        self._pending = (request, payload)
        self.ask_again()

    def _interpret(self, packet: Packet, events: list[HostEvent]) -> None:
        if packet.boot_id != self._boot_id:
            if self._boot_id:
                events.append(Rebooted(packet.boot_id))
                self.state = HostState.IDENTIFYING
                self._ask(MessageType.IDENTIFY)
            self._boot_id = packet.boot_id
        match packet.type:
            case MessageType.FRAME if self.state is HostState.RUNNING:
                events.append(_frame(packet))
            case MessageType.FRAME_PART if self.state is HostState.RUNNING:
                if (part := _frame_part(packet)) is None:
                    self.messages.unknown += 1
                else:
                    events.append(part)
            case MessageType.FRAME | MessageType.FRAME_PART | MessageType.STOPPED:
                self.messages.stale += 1
            case MessageType.PONG:
                events.append(Pong(packet.payload, packet.board_ticks))
            case MessageType.STATUS:
                events.append(decode_message(BoardStatus, packet.payload))
            case MessageType.LOG:
                events.append(decode_message(BoardLog, packet.payload))
            case (
                MessageType.IDENTITY
                | MessageType.DESCRIPTION
                | MessageType.CONFIGURED
                | MessageType.STARTED
                | MessageType.REFUSED
            ):
                self._answered(packet, events)
            case _:
                self.messages.unknown += 1

    def _answered(self, packet: Packet, events: list[HostEvent]) -> None:
        expected = self._pending and self._pending[0]
        refused = packet.type == MessageType.REFUSED
        if packet.sequence != self._request_number or (
            not refused and _ANSWER_TO[MessageType(packet.type)] != expected
        ):
            self.messages.stale += 1
            return
        match packet.type:
            case MessageType.IDENTITY:
                self._identity = decode_message(Identity, packet.payload)
                self.state = HostState.DESCRIBING
                self._ask(MessageType.DESCRIBE)
            case MessageType.DESCRIPTION:
                description = decode_message(Description, packet.payload)
                events.append(Described(self._identity, description, packet.boot_id))
                self.state = HostState.DESCRIBED
                self._pending = None
            case MessageType.CONFIGURED:
                self._configuration = decode_message(Configuration, packet.payload)
                self.state = HostState.STARTING
                self._ask(MessageType.START)
            case MessageType.STARTED:
                events.append(Started(self._configuration))
                self.state = HostState.RUNNING
                self._pending = None
            case MessageType.REFUSED:
                events.append(decode_message(Refusal, packet.payload))
                self.state = HostState.REFUSED
                self._pending = None


def _frame(packet: Packet) -> Frame:
    if len(packet.payload) != CHANNEL_COUNT * SINGLE_TONE_STRUCT.size:
        raise MalformedMessageError(
            f"a frame has {CHANNEL_COUNT} records of {SINGLE_TONE_STRUCT.size} bytes, got {len(packet.payload)} bytes"
        )
    records = tuple(SingleToneRecord._make(values) for values in SINGLE_TONE_STRUCT.iter_unpack(packet.payload))
    return Frame(packet.sequence, packet.board_ticks, packet.size_bytes, records)


def _frame_part(packet: Packet) -> FramePart | None:
    if len(packet.payload) < BLOCK_STRUCT.size:
        raise MalformedMessageError(f"a frame part begins with {BLOCK_STRUCT.size} bytes, got {len(packet.payload)}")
    block = Block._make(BLOCK_STRUCT.unpack_from(packet.payload))
    if block.encoding != BlockEncoding.TONE_12:
        return None
    tones = packet.payload[BLOCK_STRUCT.size :]
    if len(tones) != block.tones * TONE_STRUCT.size or block.channel >= CHANNEL_COUNT or block.part >= block.parts:
        raise MalformedMessageError(f"channel {block.channel} with {block.tones} tones in {len(tones)} bytes")
    return FramePart(packet.sequence, packet.board_ticks, packet.size_bytes, block, tones)
