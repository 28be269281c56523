"""Speed of the packet decoder on one core beside COBS with CRC-32: 204-byte frames, and parts of skin32's frames.

Run it with `make bench`, or `python benchmarks/codec.py`. Rates are the best of rounds: what else the machine does
slows them. COBS gives back whole packets and no header; their CRC-32 is checked, too.
"""

import os
import time
from collections.abc import Callable
from itertools import islice
from zlib import crc32

from firmware_protocol.device import DeviceSession
from firmware_protocol.host import HostSession
from firmware_protocol.layouts import SINGLE_TONE_STRUCT, TONE_STRUCT, MessageType
from firmware_protocol.messages import Configuration, CounterKind, Description, Identity
from firmware_protocol.packets import MAX_PACKET_BYTES, Packet, PacketDecoder, encode_packet

try:
    from cobs import cobs
except ImportError:
    cobs = None

CHUNK_BYTES = 256 * 1024
PIECE_BYTES = 64
STREAM_BYTES = 8 * 2**20
ROUNDS = 7


def device() -> DeviceSession:
    return DeviceSession(Identity("", "", "", 0), Description(CounterKind.SINGLE_TONE, 4, 1, 1, 1, 9, ""), 1)


def small_frames() -> list[bytes]:
    session = device()
    frame_bytes = 4 * SINGLE_TONE_STRUCT.size
    return [session.frame(number, number, os.urandom(frame_bytes)) for number in range(STREAM_BYTES // 204)]


def skin_parts() -> list[bytes]:
    session = device()
    channels = [os.urandom(3072 * TONE_STRUCT.size) for _ in range(4)]
    return [part for number in range(56) for part in session.frame_parts(number, number, channels)]


def chunks(stream: bytes, chunk_bytes: int) -> list[bytes]:
    return [stream[start : start + chunk_bytes] for start in range(0, len(stream), chunk_bytes)]


def best_s(work: Callable[[list[bytes]], int], pieces: list[bytes], packets: int) -> float:
    best = float("inf")
    for _ in range(ROUNDS):
        started = time.process_time()
        found = work(pieces)
        best = min(best, time.process_time() - started)
        if found != packets:
            raise AssertionError(f"{found} of {packets} packets were found")
    return best


def decode(pieces: list[bytes]) -> int:
    decoder = PacketDecoder(from_board=True)
    return sum(len(decoder.feed(piece)) for piece in pieces)


def decode_by_session(pieces: list[bytes]) -> int:
    host, board = HostSession(), device()
    while not host.receive(board.receive(host.data_to_send(), 0)):
        pass
    host.configure(Configuration(1))
    while not host.receive(board.receive(host.data_to_send(), 0)):
        pass
    return sum(len(host.receive(piece)) for piece in pieces)


def decode_cobs(pieces: list[bytes]) -> int:
    """Split at the zeros, decode, check the CRC and keep the payload."""
    tail, payloads = b"", []
    for piece in pieces:
        *packets, tail = (tail + piece).split(b"\0")
        for packet in packets:
            body = cobs.decode(packet)
            if crc32(body) == 0x2144DF1C:
                payloads.append(body[:-4])
    return len(payloads)


def line(name: str, seconds: float, stream_bytes: int, packets: int) -> None:
    print(f"{name:44}{stream_bytes / seconds / 1e6:10.0f} MB/s{seconds / packets * 1e6:10.2f} us a packet")


def compare(name: str, packets: list[bytes]) -> None:
    stream = b"".join(packets)
    print(f"{name}: {len(packets)} packets, {len(stream) / len(packets):.0f} bytes each on average")
    for how, work, chunk_bytes in (
        ("packets, 256 kB at once", decode, CHUNK_BYTES),
        ("host session, 256 kB at once", decode_by_session, CHUNK_BYTES),
        ("packets, one read each", decode, len(packets[0])),
        ("packets, 64 bytes at once", decode, PIECE_BYTES),
    ):
        line(f"  {how}", best_s(work, chunks(stream, chunk_bytes), len(packets)), len(stream), len(packets))
    if cobs is None:
        print("  COBS: not installed (pip install cobs)")
        return
    stuffed = b"".join(cobs.encode(packet) + b"\0" for packet in packets)
    seconds = best_s(decode_cobs, chunks(stuffed, CHUNK_BYTES), len(packets))
    line("  cobs + crc32, 256 kB at once", seconds, len(stream), len(packets))


def worst_case() -> None:
    """Time sound headers that each promise a long payload and have no sound CRC: the most work per byte there is."""
    header = encode_packet(MessageType.FRAME, 0, bytes(MAX_PACKET_BYTES - 28))[:24]
    stream = header * (2**20 // len(header))
    decoder = PacketDecoder(from_board=True)
    started = time.process_time()
    found = [item for piece in chunks(stream, CHUNK_BYTES) for item in decoder.feed(piece) if isinstance(item, Packet)]
    seconds = time.process_time() - started
    print(f"forged headers alone, {len(found)} accepted: {len(stream) / seconds / 1e6:.1f} MB/s")


if __name__ == "__main__":
    compare("quartz16", small_frames())
    compare("skin32", list(islice(skin_parts(), 1120)))
    worst_case()
