"""The board's side of a session: answers to requests and packing of frames (PROTOCOL.md, section 3)."""

from enum import Enum
from itertools import count

from firmware_protocol.layouts import BLOCK_STRUCT, FROM_BOARD, TONE_STRUCT, Block, BlockEncoding, MessageType
from firmware_protocol.messages import (
    BoardLog,
    BoardStatus,
    Configuration,
    Description,
    Identity,
    MalformedMessageError,
    Refusal,
    RefusalCode,
    decode_message,
    encode_message,
)
from firmware_protocol.packets import MAX_PAYLOAD_BYTES, Packet, PacketDecoder, encode_packet

MAX_TONES_PER_PART = (MAX_PAYLOAD_BYTES - BLOCK_STRUCT.size) // TONE_STRUCT.size


class DeviceState(Enum):
    """What the board is doing; one row of the table in PROTOCOL.md each."""

    IDLE = "idle"
    CONFIGURED = "configured"
    RUNNING = "running"


class DeviceSession:
    """Bytes from the host in, answers out; the board asks `state` and `configuration` what to do.

    `started` counts the runs, so that a board sees a new START; a repeated START does not begin a new run.
    """

    def __init__(self, identity: Identity, description: Description, boot_id: int) -> None:
        self._identity = identity
        self._description = description
        self._boot_id = boot_id
        self._decoder = PacketDecoder(from_board=False)
        self._notices = count()
        self.state = DeviceState.IDLE
        self.configuration: Configuration | None = None
        self.started = 0

    def receive(self, data: bytes, board_ticks: int) -> bytes:
        """Take bytes from the host, received at `board_ticks`; return the answers."""
        return b"".join(
            self._answer(packet, board_ticks) for packet in self._decoder.feed(data) if isinstance(packet, Packet)
        )

    def frame(self, sequence: int, board_ticks: int, records: bytes) -> bytes:
        """Return the packet of one single-tone frame."""
        return self._packet(MessageType.FRAME, sequence, board_ticks, records)

    def frame_parts(self, sequence: int, board_ticks: int, channels: list[bytes]) -> list[bytes]:
        """Return the packets of one channelised frame from each channel's tone records."""
        tones = len(channels[0]) // TONE_STRUCT.size
        parts_per_channel = -(-tones // MAX_TONES_PER_PART)
        step = -(-tones // parts_per_channel)
        starts = range(0, tones, step)
        packets = []
        for channel, records in enumerate(channels):
            for index, first in enumerate(starts):
                size = min(step, tones - first)
                block = Block(
                    channel,
                    BlockEncoding.TONE_12,
                    first,
                    size,
                    channel * len(starts) + index,
                    len(channels) * len(starts),
                )
                body = records[first * TONE_STRUCT.size : (first + size) * TONE_STRUCT.size]
                packets.append(
                    self._packet(MessageType.FRAME_PART, sequence, board_ticks, BLOCK_STRUCT.pack(*block) + body)
                )
        return packets

    def status(self, status: BoardStatus, board_ticks: int) -> bytes:
        return self._packet(MessageType.STATUS, next(self._notices), board_ticks, encode_message(status))

    def log(self, log: BoardLog, board_ticks: int) -> bytes:
        return self._packet(MessageType.LOG, next(self._notices), board_ticks, encode_message(log))

    def _packet(self, message_type: int, sequence: int, board_ticks: int, payload: bytes = b"") -> bytes:
        return encode_packet(message_type, sequence, payload, board_ticks=board_ticks, boot_id=self._boot_id)

    def _answer(self, request: Packet, board_ticks: int) -> bytes:
        try:
            payload = self._carry_out(request)
        except _RefusedError as refused:
            payload = encode_message(refused.refusal)
            return self._packet(MessageType.REFUSED, request.sequence, board_ticks, payload)
        return self._packet(request.type | FROM_BOARD, request.sequence, board_ticks, payload)

    def _carry_out(self, request: Packet) -> bytes:
        match request.type:
            case MessageType.IDENTIFY:
                return encode_message(self._identity)
            case MessageType.DESCRIBE:
                return encode_message(self._description)
            case MessageType.PING:
                return request.payload
            case MessageType.CONFIGURE:
                return self._configure(request.payload)
            case MessageType.START:
                if self.state is DeviceState.IDLE:
                    raise _RefusedError(RefusalCode.NOT_IN_THIS_STATE, "START needs a configuration")
                if self.state is DeviceState.CONFIGURED:
                    self.state = DeviceState.RUNNING
                    self.started += 1
                return b""
            case MessageType.STOP:
                if self.state is DeviceState.RUNNING:
                    self.state = DeviceState.CONFIGURED
                return b""
            case _:
                raise _RefusedError(RefusalCode.UNKNOWN_MESSAGE, f"unknown message 0x{request.type:02X}")

    def _configure(self, payload: bytes) -> bytes:
        try:
            configuration = decode_message(Configuration, payload)
        except MalformedMessageError as error:
            raise _RefusedError(RefusalCode.MALFORMED, str(error)) from error
        low, high = self._description.gate_ticks_min, self._description.gate_ticks_max
        if not low <= configuration.gate_ticks <= high:
            raise _RefusedError(
                RefusalCode.OUT_OF_RANGE, f"gate_ticks must be {low} to {high}, got {configuration.gate_ticks}"
            )
        self.state = DeviceState.CONFIGURED
        self.configuration = configuration
        return encode_message(configuration)


class _RefusedError(Exception):
    def __init__(self, code: RefusalCode, text: str) -> None:
        super().__init__(text)
        self.refusal = Refusal(code, text)
