"""The board's side of a session: answers to requests and packing of frames (PROTOCOL.md, sections 4, 6 and 7)."""

import re
from functools import cache
from itertools import count
from zlib import crc32

from firmware_protocol.layouts import (
    BLOCK_STRUCT,
    CHANNEL_COUNT,
    FROM_BOARD,
    PROTOCOL_MAJOR,
    TONE_STRUCT,
    Block,
    BlockEncoding,
    Capability,
    MessageType,
)
from firmware_protocol.messages import (
    LEAST_CREDIT_BYTES,
    BoardLog,
    BoardStatus,
    Configuration,
    Description,
    Identity,
    LogLevel,
    MalformedMessageError,
    Refusal,
    RefusalCode,
    decode_message,
    encode_message,
)
from firmware_protocol.packets import (
    MAX_PACKET_BYTES,
    MAX_PAYLOAD_BYTES,
    ForeignVersion,
    Packet,
    PacketDecoder,
    encode_header,
    encode_packet,
    packet_check,
)
from firmware_protocol.states import BOARD, BoardState, Reaction

MAX_TONES_PER_PART = (MAX_PAYLOAD_BYTES - BLOCK_STRUCT.size) // TONE_STRUCT.size
MAX_TONES = 255 // CHANNEL_COUNT * MAX_TONES_PER_PART  # on each channel: a frame has at most 255 parts
PING_BYTES = 8
VANISHED_S = 10  # after this time without a byte, a TCP host is replaced by another that connects
SERIAL_NUMBER = re.compile("[A-Za-z0-9][A-Za-z0-9._-]{0,62}")


class DeviceSession:
    """Bytes from the host in, answers out; the board asks `state` and `configuration` what to do.

    `started` counts the runs, so that a board sees a new START; a repeated START does not begin a new run. `located`
    counts the requests to blink. While `fault` gives the reason why the board cannot count, START is refused with it.
    Frames, STATUS and LOG are for a host that has `asked` something since it came.

    Raises
    ------
    ValueError
        If the identity promises less credit than every board gives, or its serial number has other characters than
        PROTOCOL.md permits; if the description has gates of 2^32 ticks, or more tones than a frame carries.
    """

    def __init__(self, identity: Identity, description: Description, boot_id: int) -> None:
        if identity.credit_bytes < LEAST_CREDIT_BYTES:
            raise ValueError(f"credit_bytes must be at least {LEAST_CREDIT_BYTES}, got {identity.credit_bytes}")
        if not SERIAL_NUMBER.fullmatch(identity.serial_number):
            raise ValueError(f"serial_number must match {SERIAL_NUMBER.pattern}, got {identity.serial_number!r}")
        if not 0 < description.gate_ticks_max < 1 << 32:
            raise ValueError(f"gate_ticks_max must be 1 to 2^32 - 1, got {description.gate_ticks_max}")
        if description.tones > MAX_TONES:
            raise ValueError(f"tones must be at most {MAX_TONES}, got {description.tones}")
        self._identity = identity
        self._description = description
        self._boot_id = boot_id
        self._decoder = PacketDecoder(from_board=False, max_packet_bytes=min(identity.credit_bytes, MAX_PACKET_BYTES))
        self._notices = count()
        self.counts = self._decoder.counts
        self.state = BoardState.IDLE
        self.configuration: Configuration | None = None
        self.started = 0
        self.located = 0
        self.asked = False
        self._fault: str | None = None
        self._connected = False  # to a host, over TCP
        self._received_ticks = 0  # when its last bytes came, or it connected

    @property
    def fault(self) -> str | None:
        """Reason why the board cannot count; None while it can."""
        return self._fault

    def set_fault(self, reason: str | None, board_ticks: int) -> bytes:
        """Set or clear the fault; return the LOG to send if it ends a run and the host has `asked`, otherwise b""."""
        self._fault = reason
        if reason is None or self.state is not BoardState.RUNNING:
            return b""
        self.state = BoardState.CONFIGURED
        return self.log(BoardLog(LogLevel.ERROR, reason), board_ticks) if self.asked else b""

    @property
    def waiting_bytes(self) -> int:
        """Received bytes of a request that is not complete yet."""
        return self._decoder.waiting_bytes

    def begin(self) -> None:
        """Become idle and discard an incomplete request; for links on which a host can signal that it begins afresh."""
        self.connection_ended()
        self.state = BoardState.IDLE
        self.configuration = None

    def connection_ended(self) -> None:
        """Discard an incomplete request, and wait for the next host's first request; the state stays."""
        self._decoder.abandon()
        self.asked = self._connected = False

    def host_connects(self, board_ticks: int) -> bool:
        """Return whether to serve a new TCP connection, which ends the former one; if not, close the new one."""
        vanished_ticks = VANISHED_S * self._description.reference_millihertz // 1000
        if self._connected and board_ticks - self._received_ticks < vanished_ticks:
            return False
        self.connection_ended()
        self._connected, self._received_ticks = True, board_ticks
        return True

    def receive(self, data: bytes, board_ticks: int) -> bytes:
        """Process bytes from the host, received at `board_ticks`; return the answers."""
        if data:
            self._received_ticks = board_ticks  # also without a packet: the host is still connected
        answers = []
        for found in self._decoder.feed(data):
            if isinstance(found, Packet):
                self.asked = True
                answers.append(self._answer(found, board_ticks))
            elif isinstance(found, ForeignVersion) and not found.type & FROM_BOARD:
                text = f"this board speaks version {PROTOCOL_MAJOR}, not {found.major}"
                answers.append(self._refusal(Refusal(RefusalCode.OTHER_VERSION, text), found.sequence, board_ticks))
        return b"".join(answers)

    def frame(self, sequence: int, board_ticks: int, records: bytes) -> bytes:
        """Return the packet of one single-tone frame."""
        return self._packet(MessageType.FRAME, sequence, board_ticks, records)

    def frame_parts(self, sequence: int, board_ticks: int, channels: list[bytes]) -> bytes:
        """Return the packets of one channelised frame from each channel's tone records."""
        pieces: list[bytes | memoryview] = []
        heads: dict[int, tuple[bytes, int]] = {}  # by the length of the body, with CRC: those of equal length are alike
        views = [memoryview(records) for records in channels]
        for channel, start, end, block in _blocks(len(channels[0]) // TONE_STRUCT.size, len(channels)):
            if (head := heads.get(end - start)) is None:
                size = len(block) + end - start
                encoded = encode_header(MessageType.FRAME_PART, sequence, size, board_ticks, self._boot_id)
                head = heads[end - start] = encoded, crc32(encoded)
            body = views[channel][start:end]
            pieces += head[0], block, body, packet_check(crc32(body, crc32(block, head[1])))
        return b"".join(pieces)

    def status(self, status: BoardStatus, board_ticks: int) -> bytes:
        return self._packet(MessageType.STATUS, next(self._notices), board_ticks, encode_message(status))

    def log(self, log: BoardLog, board_ticks: int) -> bytes:
        return self._packet(MessageType.LOG, next(self._notices), board_ticks, encode_message(log))

    def _packet(self, message_type: int, sequence: int, board_ticks: int, payload: bytes = b"") -> bytes:
        return encode_packet(message_type, sequence, payload, board_ticks=board_ticks, boot_id=self._boot_id)

    def _refusal(self, refusal: Refusal, sequence: int, board_ticks: int) -> bytes:
        return self._packet(MessageType.REFUSED, sequence, board_ticks, encode_message(refusal))

    def _answer(self, request: Packet, board_ticks: int) -> bytes:
        reaction = BOARD.get((self.state, request.type))
        try:
            if reaction is None:
                raise _unknown(request.type)
            payload = self._carry_out(request, reaction)
        except _RefusedError as refused:
            return self._refusal(refused.refusal, request.sequence, board_ticks)
        self.state = reaction.next_state
        return self._packet(reaction.answer, request.sequence, board_ticks, payload)

    def _carry_out(self, request: Packet, reaction: Reaction) -> bytes:
        match request.type:
            case MessageType.IDENTIFY:
                return encode_message(self._identity)
            case MessageType.DESCRIBE:
                return encode_message(self._description)
            case MessageType.PING:
                if len(request.payload) != PING_BYTES:
                    raise _RefusedError(
                        RefusalCode.MALFORMED, f"PING needs {PING_BYTES} bytes, got {len(request.payload)}"
                    )
                return request.payload
            case MessageType.LOCATE:
                if not self._description.capabilities & Capability.LOCATE:
                    raise _unknown(request.type)
                self.located += 1
            case MessageType.CONFIGURE:
                self.configuration = self._allowed(request.payload)
                return encode_message(self.configuration)
            case MessageType.START:
                if reaction.refusal is not None:
                    raise _RefusedError(reaction.refusal, "START needs a configuration")
                if self._fault is not None:
                    raise _RefusedError(RefusalCode.FAULT, self._fault)
                self.started += self.state is not reaction.next_state
        return b""

    def _allowed(self, payload: bytes) -> Configuration:
        try:
            configuration = decode_message(Configuration, payload)
        except MalformedMessageError as error:
            text = "CONFIGURE needs gate_ticks, a number of 1 to 8 bytes"
            raise _RefusedError(RefusalCode.MALFORMED, text) from error
        low, high = self._description.gate_ticks_min, self._description.gate_ticks_max
        step, gate_ticks = self._description.gate_ticks_step, configuration.gate_ticks
        if not low <= gate_ticks <= high:
            raise _RefusedError(RefusalCode.OUT_OF_RANGE, f"gate_ticks must be {low} to {high}, got {gate_ticks}")
        if gate_ticks % step:
            raise _RefusedError(RefusalCode.OUT_OF_RANGE, f"gate_ticks must be a multiple of {step}, got {gate_ticks}")
        return configuration


@cache
def _blocks(tones: int, channels: int) -> list[tuple[int, int, int, bytes]]:
    """Return channel, start and end in its records, and encoded block of each part of a frame."""
    parts_per_channel = -(-tones // MAX_TONES_PER_PART)
    step = -(-tones // parts_per_channel)
    starts = [(channel, first) for channel in range(channels) for first in range(0, tones, step)]
    blocks = []
    for part, (channel, first) in enumerate(starts):
        size = min(step, tones - first)
        block = BLOCK_STRUCT.pack(*Block(channel, BlockEncoding.TONE_12, first, size, part, len(starts)))
        blocks.append((channel, first * TONE_STRUCT.size, (first + size) * TONE_STRUCT.size, block))
    return blocks


class _RefusedError(Exception):
    def __init__(self, code: RefusalCode, text: str) -> None:
        super().__init__(text)
        self.refusal = Refusal(code, text)


def _unknown(message_type: int) -> _RefusedError:
    return _RefusedError(RefusalCode.UNKNOWN_MESSAGE, f"unknown message 0x{message_type:02X}")
