"""The C reference and the Python implementation make the same of the same bytes."""

import random
from dataclasses import fields, replace
from operator import attrgetter

from c_reference import board_command, event_line, hexadecimal, run_commands

from firmware_protocol.device import DeviceSession
from firmware_protocol.layouts import FROM_BOARD, MessageType
from firmware_protocol.messages import BoardLog, Configuration, Description, Identity, LogLevel, encode_message
from firmware_protocol.packets import SYNC, ByteCounts, PacketDecoder, encode_packet

STREAMS = 3_000
BOOT_ID = 0xC0FFEE
NUMBERS = attrgetter(*(field.name for field in fields(ByteCounts)))  # `astuple` copies each, at length
LONG_TEXT = "a" + "é" * 200  # is cut within a character
IDENTITY = Identity("differential", "0042", "1.0 é", 0, 64, 2)
DESCRIPTION = Description(1, 4, 3072, 10**12, 1000, 2**32 - 8, "plate", 7, 2**63, 68 * 256, 3, 8)


def random_payload(rng: random.Random, message_type: int) -> bytes:
    draw = rng.random()
    if message_type == MessageType.CONFIGURE and draw < 0.8:
        gate_ticks = rng.choice((8 * rng.randrange(125, 10**6), rng.randrange(2000), rng.randrange(2**64)))
        payload = encode_message(Configuration(gate_ticks))
        extra = rng.choice((b"", b"", bytes((9, 1, 0)), bytes((9,)), bytes((1, 0)), bytes((1, 9, *range(9)))))
        return payload + extra if rng.random() < 0.5 else extra + payload
    if message_type == MessageType.PING and draw < 0.8:
        return rng.randbytes(8)
    if draw < 0.9:
        return b""
    return b"".join(rng.choice((SYNC, b"\xa5", rng.randbytes(3))) for _ in range(rng.randrange(30)))


def random_piece(rng: random.Random) -> bytes:
    """A packet, sound or not, or noise."""
    if rng.random() < 0.1:
        return b"".join(rng.choice((SYNC, b"\xa5", rng.randbytes(5))) for _ in range(rng.randrange(20)))
    message_type = rng.choice(list(MessageType)[:7]) if rng.random() < 0.85 else rng.randrange(256)
    major = 1 if rng.random() < 0.9 else rng.randrange(256)
    payload = random_payload(rng, message_type)
    packet = bytearray(encode_packet(message_type, rng.randrange(2**32), payload, major=major))
    draw = rng.random()
    if draw < 0.08:
        packet[rng.randrange(len(packet))] ^= 1 << rng.randrange(8)
    elif draw < 0.14:
        del packet[rng.randrange(len(packet)) :]
    elif draw < 0.18:
        del packet[rng.randrange(len(packet))]
    elif draw < 0.22:
        packet.insert(rng.randrange(len(packet)), rng.randrange(256))
    elif draw < 0.24:
        packet[:] = encode_packet(message_type | FROM_BOARD, 1, payload, board_ticks=5, boot_id=BOOT_ID)
    return bytes(packet)


def chunks_of(rng: random.Random, stream: bytes) -> list[bytes]:
    chunks = []
    longest = rng.choice((1, 20, 60, 200, 200, 500, 500))
    while stream:
        size = rng.randint(1, longest)
        chunks.append(stream[:size])
        stream = stream[size:]
    return chunks


class Differential:
    """Both sides' commands and lines, gathered, so that the driver runs once."""

    def __init__(self) -> None:
        self.commands: list[str] = []
        self.expected: list[str] = []

    def stream(self, rng: random.Random) -> None:
        product = rng.choice((IDENTITY.product, "", LONG_TEXT, LONG_TEXT[1:]))
        identity = replace(
            IDENTITY, product=product, credit_bytes=rng.choice((64, 65, 100, 300)), reset_cause=rng.randrange(6)
        )
        description = replace(DESCRIPTION, capabilities=rng.randrange(4))
        self._session = DeviceSession(identity, description, BOOT_ID)
        self._decoder = PacketDecoder(from_board=False, max_packet_bytes=identity.credit_bytes)
        self._expect(board_command(identity, description, BOOT_ID), ["ok"])
        data = b"".join(random_piece(rng) for _ in range(rng.randint(1, 9)))
        for chunk in chunks_of(rng, data):
            self._receive(chunk, rng.randrange(2**64))
            if rng.random() < 0.05:
                self._begin()
            elif rng.random() < 0.1:
                self._fault(rng.choice((None, "reference not locked")), rng.randrange(2**64))

    def _expect(self, command: str, lines: list[str]) -> None:
        self.commands.append(command)
        self.expected += lines

    def _receive(self, chunk: bytes, ticks: int) -> None:
        events = [event_line(event) for event in self._decoder.feed(chunk)]
        answers = self._session.receive(chunk, ticks)
        self._expect(f"receive {ticks} {chunk.hex()}", events)
        self._expect("output 1000000", [f"output {answers.hex()}"])
        self._compare()

    def _begin(self) -> None:
        self._session.begin()
        self._decoder.abandon()
        self._expect("begin", [])
        self._compare()

    def _fault(self, text: str | None, ticks: int) -> None:
        log = self._session.set_fault(text, ticks)
        self._expect(f"fault {ticks} {hexadecimal((text or '').encode())}", [])
        self._expect("output 1000000", [f"output {log.hex()}"])
        self._compare()

    def _compare(self) -> None:
        session, counts = self._session, self._session.counts
        assert counts == self._decoder.counts
        self._expect("counts", [f"counts {' '.join(map(str, NUMBERS(counts)))} {session.waiting_bytes}"])
        gate_ticks = session.configuration.gate_ticks if session.configuration else 0
        state = f"state {session.state.value} {gate_ticks} {session.started} {session.located} 0 0 0 0"
        self._expect("state", [state])


def test_every_event_answer_and_count_is_the_same() -> None:
    both = Differential()
    for seed in range(STREAMS):
        both.stream(random.Random(seed))
    text = "\n".join(both.expected)
    for occurs in ("garbage", "bad_header", "bad_length", "bad_crc", "foreign", "state running"):
        assert occurs in text, f"{occurs} never happened"
    for refusal in (
        "needs gate_ticks",
        "PING needs",
        "unknown message 0x",
        "START needs",
        "multiple of",
        " to 42949672",
    ):
        assert refusal.encode().hex() in text, f"{refusal} never happened"
    assert b"reference not locked".hex() in text
    assert encode_message(BoardLog(LogLevel.ERROR, "reference not locked")).hex() in text
    assert b"speaks version 1, not".hex() in text
    printed = run_commands(both.commands)
    for line, (ours, theirs) in enumerate(zip(both.expected, printed, strict=False)):
        assert ours.rstrip() == theirs.rstrip(), f"line {line}"
    assert len(both.expected) == len(printed)
