"""Which bytes from a board and which commands make something escape: an exception, a wrong account, a change.

Run it with `make fuzz`, or `python benchmarks/fuzz.py wire|commands [--inputs N] [--seed S]`. Wire: pieces of a stream
of sound packets, mutated at random and cut anywhere, through every parser; accounts are exact and memory is bounded.
Commands: each is refused or answered, N where nothing may be changed, and a tenth of them where everything may.
"""

import argparse
import asyncio
import json
import logging
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from command_stand_ins import BOOT_ID, StandIn, configured, handlers_on

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
from resonator_daemon.daemon.service.command_handlers import EVENTS_BYTES_MAX
from resonator_daemon.mqtt.codec import Incoming, Outgoing
from resonator_daemon.mqtt.commands import (
    AT_ONCE,
    CORRELATION_BYTES_MAX,
    PAYLOAD_BYTES_MAX,
    RESPONSE_TOPIC_BYTES_MAX,
    WAITING_MAX,
    Commands,
)
from resonator_daemon.mqtt.verbs import ID_LENGTH_MAX, VERBS, ErrorCode

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
WIRE_PIECES = (SYNC, b"\xa5", b"\x5a", b"\xff\xff", bytes(3))
TYPES = tuple(MessageType)
INPUTS_A_LIFE = 200  # of a decoder or a session, then a new one begins


def mutated(raw: bytes, rng: random.Random, pieces: Sequence[bytes] = WIRE_PIECES, choices: int = 12) -> bytes:
    """Return bytes with some flipped, cut out, put in or repeated; of more choices than 5, often none."""
    choice = int(rng.random() * choices)
    at = int(rng.random() * (len(raw) + 1))
    if choice == 0 and at < len(raw):
        return raw[:at] + bytes((raw[at] ^ 1 << int(rng.random() * 8),)) + raw[at + 1 :]
    if choice == 1:
        return raw[:at] + raw[at + 1 + int(rng.random() * 8) :]
    if choice == 2:
        return raw[:at] + rng.choice(pieces) + raw[at:]
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


# Commands.

BASE = "resonator/left"
SOUND: dict[str, tuple[dict[str, Any], ...]] = {
    "ping": ({}, {"id": "question 7"}),
    "events": ({}, {"after_seq": 8, "daemon_boot_id": BOOT_ID}),
    "start_recording": ({}, {"label": "drop-1"}),
    "mark": ({"text": "touched"},),
    "set_window": ({"window_ms": 20}, {"window_ms": 10, "step_ms": 2}),
}
VERBS_TRIED = (*VERBS, "unknown", "TARE", "tare ", "../tare", "a/b", "#", "\ud800", "x" * 300, "")
TEXTS = ("", "forces", "../../etc/passwd", "a\x00b", "é\u202e", "\ud83d", "x" * 500, "drop-1", "info", "NaN", "%s{0}")
NUMBERS = (0, -1, 1, 10, 20, 0.5, 1e-320, 1e308, 2**63, 2**64, 10**19, True, False, None)
BROKEN = (b"NaN", b"1e999", b"1" * 5000, b"[" * 3000, b'{"a":' * 2000, b'{"label":"a","label":"b"}', b"\xef\xbb\xbf{}")
PIECES = (b'"', b"{", b"}", b"[", b"]", b",", b":", b"\\u0000", b"\xff", b"\\", b"null", b"NaN", b"1e999", b"9" * 30)
OWN_TOPICS = (f"{BASE}/rsp/tare/17", f"{BASE}/state/daemon", f"{BASE}/cmd/tare", "resonator/right/info", "resonator")
RESPONSE_TOPICS = ("robot/answers", *OWN_TOPICS, "$SYS/broker", "a/#", "+", "", "a\x00b", "\ud800", "x" * 2000)
LATE_S = 30.0
ID_SHARE = 0.2  # of requests
QUICK_SHARE = 1e-3  # of commands, after which many come at once
TASKS_MAX = 3 * WAITING_MAX


class EscapedError(Exception):
    """Something happened that must not."""


class Inputs:
    """Makes commands at random: payload, verb, response topic and correlation data are sound, mutated or random."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._sound = tuple((verb, json.dumps(it).encode()) for verb in VERBS for it in SOUND.get(verb, ({},)))

    def message(self) -> Incoming:
        draw = self._rng.random
        verb, payload = self._sound[int(draw() * len(self._sound))]
        choice = draw()
        if choice < 0.3:
            payload = mutated(mutated(payload, self._rng, PIECES, 5), self._rng, PIECES)
        elif choice < 0.55:
            payload = json.dumps(self._request(verb)).encode()
        elif choice < 0.65:
            payload = json.dumps(self._tree(0)).encode()
        elif choice < 0.72:
            payload = self._rng.randbytes(int(draw() * 200))
        elif choice < 0.75:
            payload = BROKEN[int(draw() * len(BROKEN))]
        elif choice < 0.752:
            payload += bytes(PAYLOAD_BYTES_MAX)
        if draw() < 0.05:
            verb = VERBS_TRIED[int(draw() * len(VERBS_TRIED))]
        return Incoming(f"{BASE}/cmd/{verb}", payload, draw() < 0.03, self._response_topic(), self._correlation())

    def _request(self, verb: str) -> dict[str, Any]:
        """Return a request with the verb's own keys, mostly, and any values."""
        own = [key for key in VERBS[verb].request.model_fields if key != "id"]
        fields, known = (*own, *TEXTS), len(own) or 1
        keys = [fields[int(self._rng.random() ** 2 * 2 * known) % len(fields)] for _ in range(known)]
        keys += ["id"] * (self._rng.random() < ID_SHARE)
        return {key: self._value(1) for key in keys}

    def _tree(self, depth: int) -> Any:
        kind = self._rng.random()
        if depth < 12 and kind < 0.4:
            return {TEXTS[int(self._rng.random() * len(TEXTS))]: self._tree(depth + 1) for _ in range(2)}
        if depth < 12 and kind < 0.6:
            return [self._tree(depth + 1) for _ in range(int(self._rng.random() * 3))]
        return self._value(2)

    def _value(self, lists: int) -> Any:
        kind = self._rng.random()
        if kind < 0.4:
            return NUMBERS[int(self._rng.random() * len(NUMBERS))]
        if kind < 0.5:
            return self._rng.uniform(-5, 50)
        if kind < 0.9 or not lists:
            return TEXTS[int(self._rng.random() * len(TEXTS))]
        return [self._value(lists - 1) for _ in range(int(self._rng.random() * 20))]

    def _response_topic(self) -> str | None:
        choice = self._rng.random()
        if choice < 0.85:
            return None
        if choice < 0.97:
            return RESPONSE_TOPICS[int(self._rng.random() * len(RESPONSE_TOPICS))]
        return "".join(chr(int(self._rng.random() ** 4 * 0x110000)) for _ in range(int(self._rng.random() * 40)))

    def _correlation(self) -> bytes | None:
        choice = self._rng.random()
        return None if choice < 0.7 else self._rng.randbytes(int(choice**20 * 2 * CORRELATION_BYTES_MAX))


class Judge:
    """Looks at each answer; counts what they say."""

    def __init__(self, allowed: Collection[str]) -> None:
        self._allowed = allowed
        self.seen: Counter[str] = Counter()
        self.problems: list[str] = []

    def take(self, answer: Outgoing) -> None:
        topic = answer.topic
        own = topic.startswith(f"{BASE}/rsp/")
        if not topic or any(sign in topic for sign in "+#\0") or topic.startswith("$") or answer.retained:
            self.problems.append(f"an answer goes to {topic!a}")
        if not own and f"{topic}/".startswith("resonator/"):
            self.problems.append(f"an answer goes to {topic!a}, a daemon's own")
        if len(topic.encode()) > RESPONSE_TOPIC_BYTES_MAX or len(answer.correlation or b"") > CORRELATION_BYTES_MAX:
            self.problems.append("topic or correlation data are too long")
        if len(answer.payload) > 2 * EVENTS_BYTES_MAX:
            self.problems.append(f"an answer has {len(answer.payload)} bytes")
        said = json.loads(answer.payload)
        if not isinstance(said["id"], str | None) or len(said["id"] or "") > ID_LENGTH_MAX:
            self.problems.append(f"an answer has the id {said['id']!a}")
        if said["ok"]:
            verb = VERBS[said["verb"]]
            if verb.changes and verb.name not in self._allowed:
                self.problems.append(f"{verb.name} is said to be done")
            self.seen[verb.name] += 1
        else:
            code = said["error"]["code"]
            if code not in set(ErrorCode) or code in ("failed", "timeout"):
                self.problems.append(f"an answer says {said['error']}")
            self.seen[code] += 1


async def fuzz_commands(inputs: int, seed: int, allowed: Collection[str], directory: Path) -> Counter[str]:
    """Give so many inputs to commands; return what was answered, how often.

    Raises
    ------
    EscapedError
        An exception got out, something was changed that may not be, an answer is none or did not come.
    """
    rng = random.Random(seed)
    stand_in = StandIn(directory)
    judge = Judge(allowed)
    handlers = handlers_on(stand_in, configured(directory))
    now_s = 0.0
    asyncio.get_running_loop().set_exception_handler(lambda _, context: judge.problems.append(f"{context}"))
    commands = Commands(BASE, handlers.by_verb, allowed, judge.take, clock=lambda: now_s)
    make = Inputs(rng)
    taken = quick = 0
    for _ in range(inputs):
        message = make.message()
        taken += not message.retained  # nobody answers those
        commands.receive(message)
        if quick:  # some of these are too many
            quick -= 1
            continue
        now_s += 1.0
        quick = 2 * AT_ONCE if rng.random() < QUICK_SHARE else 0
        await asyncio.sleep(0)
        if commands.counts.total() < taken:
            await _answered(commands, taken, judge)
        if len(asyncio.all_tasks()) > TASKS_MAX:
            judge.problems.append(f"{len(asyncio.all_tasks())} tasks")
        if stand_in.acts and not allowed:
            judge.problems.append(f"without permission: {stand_in.acts}")
        if judge.problems:
            raise EscapedError(f"{message}: {judge.problems}")
        stand_in.acts.clear()
    await _answered(commands, taken, judge)
    await commands.close()
    return judge.seen


async def _answered(commands: Commands, taken: int, judge: Judge) -> None:
    """Wait until each command that was taken has become something."""
    try:
        async with asyncio.timeout(LATE_S):
            while commands.counts.total() < taken and not judge.problems:  # noqa: ASYNC110 - nobody says when
                await asyncio.sleep(0)
    except TimeoutError:
        raise EscapedError(f"{taken} commands were taken, {commands.counts} is what became of them") from None


PARSERS: dict[str, Callable[[int, random.Random], Counter[str]]] = {
    "PacketDecoder": fuzz_decoder,
    "HostSession": fuzz_host,
    "DeviceSession": fuzz_device,
    "decode_message": fuzz_messages,
}


def commands_of(allowed: Collection[str]) -> Callable[[int, random.Random], Counter[str]]:
    def run(inputs: int, rng: random.Random) -> Counter[str]:
        with tempfile.TemporaryDirectory() as folder:
            seen = asyncio.run(fuzz_commands(inputs, rng.randrange(2**31), allowed, Path(folder)))
            if files := list(Path(folder).iterdir()):
                raise EscapedError(f"files were made: {files}")
        asked = {*allowed, "payload", "unknown_verb"} | {verb.name for verb in VERBS.values() if not verb.changes}
        if missing := asked - seen.keys():
            raise EscapedError(f"{sorted(missing)} never came in {inputs} inputs")
        return seen

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("wire", "commands"))
    parser.add_argument("--inputs", type=int, help="default: ten million through each parser, or a million commands")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.disable(logging.WARNING)  # floods are part of it
    wire = options.what == "wire"
    inputs = options.inputs or (10**7 if wire else 10**6)
    both = {"nothing allowed": (commands_of(()), 1), "everything allowed": (commands_of(tuple(VERBS)), 10)}
    for name, (fuzz, share) in ({name: (fuzz, 1) for name, fuzz in PARSERS.items()} if wire else both).items():
        started = time.perf_counter()
        seen = fuzz(inputs // share, random.Random(options.seed))
        seconds = time.perf_counter() - started
        print(f"{name}: {inputs // share} inputs, {inputs / share / seconds:.0f} a second, nothing escaped")
        print("  " + ", ".join(f"{what} {count}" for what, count in sorted(seen.items())), flush=True)


if __name__ == "__main__":
    main()
