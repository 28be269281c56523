"""The host's side of a session: which request comes next and what the board's packets mean (PROTOCOL.md, section 4)."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from firmware_protocol.layouts import (
    BLOCK_STRUCT,
    CHANNEL_COUNT,
    FROM_BOARD,
    SINGLE_TONE_STRUCT,
    TONE_STRUCT,
    Block,
    BlockEncoding,
    MessageType,
    SingleToneRecord,
    single_tone_records,
)
from firmware_protocol.messages import (
    LEAST_CREDIT_BYTES,
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
from firmware_protocol.packets import (
    PACKET_OVERHEAD_BYTES,
    Damage,
    ForeignVersion,
    Packet,
    PacketDecoder,
    encode_packet,
)
from firmware_protocol.states import HOST, Cue, HostState


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
        """Send a request as soon as there is room. It replaces one of the same type that still waits."""
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
        """Discard all requests: the board has restarted."""
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


class Described(NamedTuple):
    """The board has identified and described itself; it waits for a configuration."""

    identity: Identity
    description: Description
    boot_id: int


class Started(NamedTuple):
    """Frames count from here, from number 0 unless the board was running already; also the answer to a resume."""

    configuration: Configuration


class Frame(NamedTuple):
    """One gate of a single-tone counter; `payload` is its four records as they came."""

    sequence: int
    board_ticks: int
    size_bytes: int
    payload: bytes

    @property
    def records(self) -> tuple[SingleToneRecord, ...]:
        """The four records, channel 0 first, parsed anew at each call."""
        return single_tone_records(self.payload)


class FramePart(NamedTuple):
    """Some tones of one channel in one gate; `tones` is an array of TONE_FIELDS records as bytes."""

    sequence: int
    board_ticks: int
    size_bytes: int
    block: Block
    tones: memoryview


class Pong(NamedTuple):
    """The board's tick count when it received the ping that carried `opaque`."""

    opaque: bytes
    board_ticks: int


class Located(NamedTuple):
    """The answer to LOCATE: the board blinks, or refuses."""

    refusal: Refusal | None


class Rebooted(NamedTuple):
    """The board restarted; the session is back at identifying."""

    boot_id: int


HostEvent = (
    Described
    | Started
    | Frame
    | FramePart
    | Pong
    | Located
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
    frames_outside_run: int = 0  # of those that are stale


class PacketRefusal(NamedTuple):
    """Why a sound packet is refused: a code for programs, and a sentence with what came and what is needed."""

    code: Literal["frame_length", "frame_part", "message_fields", "frame_kind", "frame_ticks"]
    text: str


_REFUSALS_MAX = 16  # reasons with their own text
_FRAME = int(MessageType.FRAME)  # compared with every packet: a plain integer, as the next two
_FRAME_PART = int(MessageType.FRAME_PART)
_TONE_12 = int(BlockEncoding.TONE_12)
_TONE_BYTES, _BLOCK_BYTES = TONE_STRUCT.size, BLOCK_STRUCT.size
_FRAME_BYTES = CHANNEL_COUNT * SINGLE_TONE_STRUCT.size
_FRAME_PACKET_BYTES = PACKET_OVERHEAD_BYTES + _FRAME_BYTES
_HANDSHAKE: Mapping[tuple[int, int], Cue] = {
    (MessageType.IDENTIFY, MessageType.IDENTITY): Cue.IDENTITY,
    (MessageType.DESCRIBE, MessageType.DESCRIPTION): Cue.DESCRIPTION,
    (MessageType.CONFIGURE, MessageType.CONFIGURED): Cue.CONFIGURED,
    (MessageType.START, MessageType.STARTED): Cue.STARTED,
}
_CUES: Mapping[tuple[int, int], Cue] = {
    **_HANDSHAKE,
    **{(request, MessageType.REFUSED): Cue.REFUSED for request, _ in _HANDSHAKE},
}
_ANSWERS = {*(answer for _, answer in _HANDSHAKE), MessageType.STOPPED, MessageType.LOCATED, MessageType.REFUSED}


def _refusal(packet: Packet, error: MalformedMessageError) -> PacketRefusal:
    kind = MessageType(packet.type)
    if kind is MessageType.FRAME:
        return PacketRefusal("frame_length", str(error))
    return PacketRefusal("frame_part" if kind is MessageType.FRAME_PART else "message_fields", f"{kind.name}: {error}")


class HostSession:
    """Bytes from the board in, events out; bytes for the board in `data_to_send`.

    A new session asks the board who it is. After Described, call `configure`; after Started, frames follow.
    The caller has the clock: when `awaits_answer` has been true for 300 ms and no answer came it calls `ask_again`.
    Requests that the board has no room for wait here, in `requests`, until it has.
    `refusals` counts packets whose checksum is right, and that break the protocol, by what is wrong with them.
    """

    def __init__(self) -> None:
        self._decoder = PacketDecoder(from_board=True)
        self.requests = Requests()
        self._boot_id = 0
        self._identity: Identity
        self._configuration: Configuration
        self.state = HostState.IDENTIFYING
        self.bytes = self._decoder.counts
        self.messages = MessageCounts()
        self.refusals: Counter[PacketRefusal] = Counter()
        self._pending: Request | None = self.requests.send(MessageType.IDENTIFY)  # which the state waits for

    def restore(self, described: Described, configuration: Configuration, number: int) -> None:
        """Go on in the middle of a run that another session began; `number` is that of its last request."""
        self.requests = Requests()
        self.requests.number = number
        self.requests.credit_bytes = max(LEAST_CREDIT_BYTES, described.identity.credit_bytes)
        self._pending = None
        self._identity, self._boot_id = described.identity, described.boot_id
        self._configuration = configuration
        self.state = HostState.RUNNING

    @property
    def number(self) -> int:
        """The number of the last request; set it where another session's requests go out instead of this one's."""
        return self.requests.number

    @number.setter
    def number(self, number: int) -> None:
        self.requests.number = number

    @property
    def configuration(self) -> Configuration:
        """What the board has accepted; there is none before Started."""
        return self._configuration

    @property
    def waiting_bytes(self) -> int:
        """Received bytes of a packet that is not complete yet."""
        return self._decoder.waiting_bytes

    @property
    def awaits_answer(self) -> bool:
        """Whether a request has no answer yet, be it sent or not."""
        return self.requests.open or self._pending is not None

    def data_to_send(self) -> bytes:
        """Return and clear the bytes that the board must get."""
        data = bytes(self.requests.outgoing)
        self.requests.outgoing.clear()
        return data

    def configure(self, configuration: Configuration) -> None:
        """Choose the gate; the board is started when it has accepted.

        Raises
        ------
        ValueError
            Before the board has described itself.
        """
        self._move(Cue.CONFIGURE, encode_message(configuration))

    def resume(self) -> None:
        """Ask a board that should be running, and sends no frames, to start; it goes on counting if it does run.

        Raises
        ------
        ValueError
            In any state but running.
        """
        self._move(Cue.RESUME)

    def stop(self) -> None:
        """Request that the board stops counting. The answer is not awaited; later frames are stale."""
        self._move(Cue.STOP)

    def locate(self) -> None:
        """Ask the board to make itself seen; the answer comes as Located."""
        self.requests.send(MessageType.LOCATE)

    def ping(self, opaque: bytes) -> bool:
        """Ask for the board's tick count; `opaque` (8 bytes) comes back in Pong.

        Returns False, and nothing goes out, when the board has no room: a ping that waits measures nothing.
        """
        if not self.requests.has_room(len(opaque)):
            return False
        self.requests.send(MessageType.PING, opaque)
        return True

    def ask_again(self) -> None:
        """Treat every unanswered request as lost; repeat the one that the state waits for, under its own number."""
        self.requests.overdue(self._pending)

    def receive(self, data: bytes) -> list[HostEvent]:
        """Decode received bytes; return their events in order."""
        # The loop runs some thousand times a second: locals, and tuples made without the detour of their classes.
        new_tuple, unpack_block, overhead = tuple.__new__, BLOCK_STRUCT.unpack_from, PACKET_OVERHEAD_BYTES
        events: list[HostEvent] = []
        for found in self._decoder.feed(data):
            if isinstance(found, Packet):
                message_type, sequence, board_ticks, boot_id, payload = found
                if boot_id == self._boot_id and self.state is HostState.RUNNING:
                    size = len(payload)
                    if message_type == _FRAME and size == _FRAME_BYTES:
                        events.append(new_tuple(Frame, (sequence, board_ticks, _FRAME_PACKET_BYTES, payload)))
                        continue
                    if message_type == _FRAME_PART and size >= _BLOCK_BYTES:
                        block = new_tuple(Block, unpack_block(payload))
                        channel, encoding, _, tones, number, parts = block
                        if (
                            encoding == _TONE_12
                            and size == _BLOCK_BYTES + tones * _TONE_BYTES
                            and channel < CHANNEL_COUNT
                            and number < parts
                        ):
                            fields = sequence, board_ticks, overhead + size, block, memoryview(payload)[_BLOCK_BYTES:]
                            events.append(new_tuple(FramePart, fields))
                            continue
                try:
                    self._interpret(found, events)
                except MalformedMessageError as error:
                    self.messages.malformed += 1
                    self.refuse(_refusal(found, error))
            elif isinstance(found, Damage) or found.type & FROM_BOARD:
                events.append(found)
        return events

    def refuse(self, refusal: PacketRefusal, count: int = 1) -> None:
        """Count packets that are refused for this reason; of many different reasons the code alone is kept."""
        if refusal not in self.refusals and len(self.refusals) >= _REFUSALS_MAX:
            refusal = refusal._replace(text="in various ways")
        self.refusals[refusal] += count

    @property
    def most_refused(self) -> PacketRefusal | None:
        """The most frequent refusal of this session; None if there is none."""
        return max(self.refusals, key=self.refusals.__getitem__, default=None)

    def _move(self, cue: Cue, payload: bytes = b"") -> None:
        step = HOST.get((self.state, cue))
        if step is None:
            needed = " or ".join(state.value for state, possible in HOST if possible is cue)
            raise ValueError(f"{cue.value}: the session must be {needed}, it is {self.state.value}")
        if step.next_state is not self.state:
            self._withdraw_pending()
        self.state = step.next_state
        if step.sends is MessageType.STOP:
            self.requests.send(step.sends)
        elif step.sends is not None:
            self._withdraw_pending()
            self._pending = self.requests.send(step.sends, payload)

    def _withdraw_pending(self) -> None:
        if self._pending is not None:
            self.requests.withdraw(self._pending)
        self._pending = None

    def _interpret(self, packet: Packet, events: list[HostEvent]) -> None:
        if packet.boot_id != self._boot_id:
            if self._boot_id:
                events.append(Rebooted(packet.boot_id))
                self.requests.discard_all()
                self._pending = None
                self._move(Cue.REBOOT)
            self._boot_id = packet.boot_id
        match packet.type:
            case MessageType.FRAME | MessageType.FRAME_PART if self.state is not HostState.RUNNING:
                self.messages.stale += 1
                self.messages.frames_outside_run += 1
            case MessageType.FRAME:
                raise MalformedMessageError(f"a frame has {_FRAME_BYTES} bytes, got {len(packet.payload)}")
            case MessageType.FRAME_PART:
                self._refuse_part(packet.payload)
            case MessageType.STATUS:
                events.append(decode_message(BoardStatus, packet.payload))
            case MessageType.LOG:
                events.append(decode_message(BoardLog, packet.payload))
            case MessageType.PONG:
                self.requests.answered(packet.sequence)
                events.append(Pong(packet.payload, packet.board_ticks))
            case answer if answer in _ANSWERS:
                self._read_answer(packet, events)
            case _:
                self.messages.unknown += 1

    def _refuse_part(self, payload: bytes) -> None:
        """Count a part of a frame in an unknown encoding; raise MalformedMessageError for any other one."""
        size = len(payload)
        if size < _BLOCK_BYTES:
            raise MalformedMessageError(f"a frame part begins with {_BLOCK_BYTES} bytes, got {size}")
        block = Block(*BLOCK_STRUCT.unpack_from(payload))
        if block.encoding == _TONE_12:
            text = f"channel {block.channel} with {block.tones} tones in {size - _BLOCK_BYTES} bytes"
            raise MalformedMessageError(text)
        self.messages.unknown += 1

    def _read_answer(self, packet: Packet, events: list[HostEvent]) -> None:
        answered = self.requests.answered(packet.sequence)
        pending = self._pending
        if pending is not None and pending.number == packet.sequence:
            cue = _CUES.get((pending.type, packet.type))
            if cue is not None:
                self._go_on(packet, cue, events)
                return
        if answered is MessageType.LOCATE and packet.type == MessageType.REFUSED:
            events.append(Located(decode_message(Refusal, packet.payload)))
        elif answered is MessageType.LOCATE and packet.type == MessageType.LOCATED:
            events.append(Located(None))
        elif answered is not MessageType.STOP:
            self.messages.stale += 1

    def _go_on(self, packet: Packet, cue: Cue, events: list[HostEvent]) -> None:
        match cue:
            case Cue.IDENTITY:
                self._identity = decode_message(Identity, packet.payload)
                self.requests.credit_bytes = max(LEAST_CREDIT_BYTES, self._identity.credit_bytes)
            case Cue.DESCRIPTION:
                description = decode_message(Description, packet.payload)
                events.append(Described(self._identity, description, packet.boot_id))
            case Cue.CONFIGURED:
                self._configuration = decode_message(Configuration, packet.payload)
            case Cue.STARTED:
                events.append(Started(self._configuration))
            case Cue.REFUSED:
                events.append(decode_message(Refusal, packet.payload))
        self._withdraw_pending()
        self._move(cue)
