"""Random and damaged bytes through every parser of the wire: no exception, exact accounts, bounded memory.

Run it with `make fuzz`, or `python benchmarks/fuzz.py [--inputs N] [--seed S]`: N inputs through each. An input is a
piece of a stream of sound packets, mutated at random, cut anywhere.
"""

import argparse
import random
import time
from collections import Counter
from collections.abc import Callable, Iterator

from firmware_protocol.device import DeviceSession
from firmware_protocol.host import HostSession
from firmware_protocol.layouts import BLOCK_STRUCT, FROM_BOARD, TONE_STRUCT, Capability, MessageType
from firmware_protocol.messages import (
    MESSAGE_FIELDS,
    BoardLog,
    BoardStatus,
    Configuration,
    CounterKind,
    Description,
    Identity,
    MalformedMessageError,
    Refusal,
    decode_message,
    encode_message,
)
from firmware_protocol.packets import MAX_PACKET_BYTES, SYNC, Packet, PacketDecoder, encode_packet
from firmware_protocol.states import HostState

IDENTITY = Identity("fuzzed", "0042", "1.0", 0, credit_bytes=256)
DESCRIPTION = Description(
    CounterKind.SINGLE_TONE, 4, 1, 10**12, 10**5, 10**8, "quartz16", capabilities=Capability.LOCATE
)
MESSAGES = (
    IDENTITY,
    DESCRIPTION,
    Configuration(10**6),
    BoardStatus(3, 298_000, 9),
    BoardLog(30, "té"),
    Refusal(4, "no"),
)
PAYLOADS = (b"", bytes(8), bytes(176), *map(encode_message, MESSAGES))
PART = BLOCK_STRUCT.pack(3, 0, 0, 2, 0, 1) + bytes(2 * TONE_STRUCT.size)
TYPES = tuple(MessageType)
INPUTS_A_LIFE = 200  # of a decoder or a session, then a new one begins


def mutated(raw: bytes, rng: random.Random) -> bytes:
    """Return bytes with some flipped, cut out, put in or repeated; often none."""
    choice = int(rng.random() * 12)
    at = int(rng.random() * (len(raw) + 1))
    if choice == 0 and at < len(raw):
        return raw[:at] + bytes((raw[at] ^ 1 << int(rng.random() * 8),)) + raw[at + 1 :]
    if choice == 1:
        return raw[:at] + raw[at + 1 + int(rng.random() * 8) :]
    if choice == 2:
        return raw[:at] + rng.choice((SYNC, b"\xa5", b"\x5a", b"\xff\xff", bytes(3))) + raw[at:]
    if choice == 3:
        return raw[:at]
    if choice == 4:
        return raw[:at] + raw[: int(rng.random() * len(raw))]
    return raw


def any_packet(rng: random.Random) -> bytes:
    kind = rng.random()
    message_type = TYPES[int(rng.random() * len(TYPES))] if kind < 0.95 else int(rng.random() * 256)
    payload = PAYLOADS[int(rng.random() * len(PAYLOADS))]
    if message_type == MessageType.FRAME_PART:
        payload = PART
    elif message_type in (MessageType.IDENTITY, MessageType.DESCRIPTION, MessageType.CONFIGURED):
        payload = PAYLOADS[3 + message_type - MessageType.IDENTITY]
    elif message_type == MessageType.CONFIGURE:
        payload = PAYLOADS[5]
    if kind < 0.15:
        payload = mutated(payload, rng)
    elif kind > 0.9995:
        payload = rng.randbytes(8900)
    return encode_packet(
        message_type,
        int(rng.random() * 8),
        payload,
        boot_id=1 + (rng.random() < 0.01) if message_type & FROM_BOARD else 0,
        major=1 + (kind > 0.99),
    )


class Stream:
    """An endless stream of packets that are damaged at random, and garbage between them, in pieces of any size."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._pool = [mutated(any_packet(rng), rng) for _ in range(20_000)] + [rng.randbytes(40) for _ in range(100)]
        self._rest = b""

    def pieces(self, count: int) -> Iterator[bytes]:
        random_number, pool, rest = self._rng.random, self._pool, b""
        for _ in range(count):
            while len(rest) < 120:
                rest += pool[int(random_number() * len(pool))]
            size = 1 + int(random_number() ** 3 * 118)
            yield rest[:size]
            rest = rest[size:]


def check_accounts(decoder: PacketDecoder, limit_bytes: int) -> None:
    counts = decoder.counts
    placed = counts.accepted + counts.other_version + counts.echo + counts.discarded + decoder.waiting_bytes
    if counts.received != placed:
        raise AssertionError(f"{counts.received} bytes came, {placed} are accounted for")
    if decoder.waiting_bytes > limit_bytes:
        raise AssertionError(f"{decoder.waiting_bytes} bytes wait, {limit_bytes} may")


def fuzz_decoder(inputs: int, rng: random.Random) -> Counter[str]:
    seen: Counter[str] = Counter()
    for number, piece in enumerate(Stream(rng).pieces(inputs)):
        if number % INPUTS_A_LIFE == 0:
            limit_bytes = (64, 300, MAX_PACKET_BYTES)[number // INPUTS_A_LIFE % 3]
            decoder = PacketDecoder(from_board=number // INPUTS_A_LIFE % 2 == 0, max_packet_bytes=limit_bytes)
        for item in decoder.feed(piece):
            seen[type(item).__name__] += 1
        check_accounts(decoder, limit_bytes)
    return seen


def shaken_hands(steps: int) -> HostSession:
    """Return a session that a sound board has answered so many times; four lead to running."""
    host, device = HostSession(), DeviceSession(IDENTITY, DESCRIPTION, 1)
    for _ in range(steps):
        if host.state is HostState.DESCRIBED:
            host.configure(Configuration(10**6))
        host.receive(device.receive(host.data_to_send(), 0))
    return host


def fuzz_host(inputs: int, rng: random.Random) -> Counter[str]:
    """Fuzz a session whose user configures, pings, stops and asks again as it comes."""
    seen: Counter[str] = Counter()
    acts: tuple[Callable[[HostSession], object], ...] = (
        HostSession.ask_again,
        HostSession.stop,
        HostSession.locate,
        lambda host: host.ping(bytes(8)),
        lambda host: host.state is HostState.RUNNING and host.resume(),
    )
    for number, piece in enumerate(Stream(rng).pieces(inputs)):
        if number % INPUTS_A_LIFE == 0:
            host = shaken_hands(number // INPUTS_A_LIFE % 5)
        for event in host.receive(piece):
            seen[type(event).__name__] += 1
        if host.state is HostState.DESCRIBED:
            host.configure(Configuration(10**6))
        if (choice := int(rng.random() * 100)) < len(acts):
            acts[choice](host)
        if len(host.data_to_send()) > 2 * IDENTITY.credit_bytes:
            raise AssertionError("more was sent than the board has room for")
        check_accounts(host._decoder, MAX_PACKET_BYTES)  # noqa: SLF001 - its accounts are the ones at stake
    return seen


def fuzz_device(inputs: int, rng: random.Random) -> Counter[str]:
    seen: Counter[str] = Counter()
    answers = PacketDecoder(from_board=True)
    for number, piece in enumerate(Stream(rng).pieces(inputs)):
        if number % INPUTS_A_LIFE == 0:
            device = DeviceSession(IDENTITY, DESCRIPTION, 1)
        for answer in answers.feed(device.receive(piece, number)):
            if not isinstance(answer, Packet):
                raise TypeError(f"the board sent {answer}")
            seen[MessageType(answer.type).name] += 1
        if rng.random() < 1e-3:
            device.begin()
        check_accounts(device._decoder, IDENTITY.credit_bytes)  # noqa: SLF001 - its accounts are the ones at stake
    return seen


def fuzz_messages(inputs: int, rng: random.Random) -> Counter[str]:
    """Fuzz the codec of fields: what it accepts it can write, and reads again as the same."""
    seen: Counter[str] = Counter()
    kinds = tuple(MESSAGE_FIELDS)
    for number in range(inputs):
        payload = mutated(mutated(PAYLOADS[int(rng.random() * len(PAYLOADS))], rng), rng)
        kind = kinds[number % len(kinds)]
        try:
            message = decode_message(kind, payload)
        except MalformedMessageError:
            seen["malformed"] += 1
            continue
        seen[kind.__name__] += 1
        if decode_message(kind, encode_message(message)) != message:
            raise AssertionError(f"{message} is not what it becomes on the wire")
    return seen


PARSERS: dict[str, Callable[[int, random.Random], Counter[str]]] = {
    "PacketDecoder": fuzz_decoder,
    "HostSession": fuzz_host,
    "DeviceSession": fuzz_device,
    "decode_message": fuzz_messages,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10**7, help="through each parser (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for name, fuzz in PARSERS.items():
        started = time.perf_counter()
        seen = fuzz(arguments.inputs, random.Random(arguments.seed))
        seconds = time.perf_counter() - started
        print(f"{name}: {arguments.inputs} inputs, {arguments.inputs / seconds:.0f} a second, no crash")
        print("  " + ", ".join(f"{what} {count}" for what, count in sorted(seen.items())), flush=True)


if __name__ == "__main__":
    main()
