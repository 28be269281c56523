"""The C reference's output: what is queued, what is dropped for it, and what STATUS says, against a plain model."""

import random
from dataclasses import dataclass, field, replace

import pytest
from c_reference import CHUNK_BYTES, board_command, run_commands
from protocol_sessions import packets_in

from firmware_protocol.layouts import BLOCK_STRUCT, MessageType
from firmware_protocol.messages import (
    BoardLog,
    BoardStatus,
    Configuration,
    Description,
    Identity,
    decode_message,
    encode_message,
)
from firmware_protocol.packets import Packet, encode_packet

BOOT_ID = 99
IDENTITY = Identity("queue", "1", "1", 0, 64, 0)
DESCRIPTION = Description(0, 4, 1, 10**12, 1, 10**6, "plate", queue_bytes=CHUNK_BYTES * 12)
CONFIGURE = encode_packet(MessageType.CONFIGURE, 1, encode_message(Configuration(1000)))
START = encode_packet(MessageType.START, 2)


@dataclass
class Waiting:
    """A packet in the queue."""

    data: bytes
    frame: int | None  # number of the frame it belongs to
    first: bool = False  # of its frame
    skipped: int = 0
    begun: bool = False

    def __post_init__(self) -> None:
        self.chunks = -(-len(self.data) // CHUNK_BYTES)  # given back with its last byte


@dataclass
class Model:
    """The rules of PROTOCOL.md, in lists."""

    chunks: int
    queue: list[Waiting] = field(default_factory=list)
    status: bytes = b""
    status_due: bool = False
    ticks: int = 0
    sequence: int = 0
    dropped: int = 0
    skipped: int = 0
    reported: int = 0
    notices: int = 0
    temperature: int | None = None
    building: int | None = None  # the frame whose parts are coming
    answers_dropped: int = 0
    parts_dropped: int = 0

    def packet(self, message_type: int, sequence: int, payload: bytes) -> bytes:
        return encode_packet(message_type, sequence, payload, board_ticks=self.ticks, boot_id=BOOT_ID)

    def next_frame(self) -> Waiting | None:
        return next((waiting for waiting in self.queue if waiting.first and not waiting.begun), None)

    def make_room(self, new: Waiting) -> bool:
        while sum(waiting.chunks for waiting in self.queue) + new.chunks > self.chunks:
            oldest = self.next_frame()
            if oldest is None:
                return False
            self.queue = [waiting for waiting in self.queue if waiting.frame != oldest.frame]
            self.dropped += 1
            if oldest.frame == self.building:
                self.building = None
        return True

    def answer(self, message_type: int, sequence: int, payload: bytes) -> None:
        new = Waiting(self.packet(message_type, sequence, payload), None)
        if self.make_room(new):
            self.queue.append(new)
        else:
            self.answers_dropped += 1

    def frame(self, records: bytes) -> bool:
        new = Waiting(self.packet(MessageType.FRAME, self.sequence, records), self.sequence, True, self.skipped)
        self.sequence += 1
        self.building = None
        return self._queue_first(new)

    def part(self, part: int, parts: int, body: bytes) -> bool:
        new = Waiting(self.packet(MessageType.FRAME_PART, self.sequence, body), self.sequence, part == 0, self.skipped)
        if part == 0:
            self.building = None
            queued = self._queue_first(new)
            self.building = self.sequence if queued else None
        elif self.building is None:
            queued = False
        else:
            room = self.make_room(new)
            queued = room and self.building is not None
            self.parts_dropped += not room and self.building is not None
            if queued:
                self.queue.append(new)
        if part + 1 == parts:
            self.building = None
            self.sequence += 1
        return queued

    def _queue_first(self, new: Waiting) -> bool:
        if not self.make_room(new):
            self.dropped += 1
            return False
        self.queue.append(new)
        return True

    def log(self, level: int, text: str) -> bool:
        new = Waiting(self.packet(MessageType.LOG, self.notices, encode_message(BoardLog(level, text))), None)
        if sum(waiting.chunks for waiting in self.queue) + new.chunks > self.chunks:
            return False
        self.notices += 1
        self.queue.append(new)
        return True

    def output(self, limit: int) -> bytes:
        sent = b""
        while len(sent) < limit:
            head = self.queue[0] if self.queue else None
            following = self.next_frame()
            due = self.dropped + (self.skipped if following is None else following.skipped)
            frame_is_next = head is not None and head.first and not head.begun and due != self.reported
            if not self.status and not (head and head.begun) and (self.status_due or frame_is_next):
                status = BoardStatus(due, self.temperature, 0)
                self.status = self.packet(MessageType.STATUS, self.notices, encode_message(status))
                self.notices, self.reported, self.status_due = self.notices + 1, due, False
            left = limit - len(sent)
            if self.status:
                sent, self.status = sent + self.status[:left], self.status[left:]
            elif head is None:
                break
            else:
                head.begun = True
                sent += head.data[:left]
                head.data = head.data[left:]
                if not head.data:
                    self.queue.pop(0)
        return sent


@pytest.mark.parametrize(
    ("description", "least_chunks"),
    [
        (DESCRIPTION, 3),  # a frame: 204 bytes
        (replace(DESCRIPTION, counter_kind=1, tones=10), 3),  # a part: 28 + 8 + 120 bytes
        (replace(DESCRIPTION, counter_kind=1, tones=1000), 132),  # a full part: 8964 bytes
        (replace(DESCRIPTION, plate="p" * 255), 5),  # DESCRIPTION: 335 bytes with the numbers here
    ],
)
def test_the_queue_must_hold_the_longest_packet(description: Description, least_chunks: int) -> None:
    made = [
        run_commands([board_command(IDENTITY, replace(description, queue_bytes=CHUNK_BYTES * chunks), BOOT_ID)])
        for chunks in (least_chunks - 1, least_chunks)
    ]
    assert made == [["bad"], ["ok"]]


def found_in(printed: list[str]) -> list[Packet]:
    """Return the packets of all lines of output."""
    sent = "".join(line.partition(" ")[2] for line in printed if line.startswith("output "))
    return packets_in(bytes.fromhex(sent), from_board=True)


def running_board(chunks: int = 12) -> list[str]:
    description = replace(DESCRIPTION, queue_bytes=CHUNK_BYTES * chunks)
    commands = [board_command(IDENTITY, description, BOOT_ID)]
    return [*commands, f"receive 0 {CONFIGURE.hex()}", f"receive 0 {START.hex()}", "output 1000"]


@pytest.mark.parametrize("sent_bytes", [0, 10, 36, 40, 72])  # of two parts of 36 bytes
@pytest.mark.parametrize("made", [1, 2])
def test_a_frame_that_the_end_of_a_connection_cuts_off_counts_as_dropped(made: int, sent_bytes: int) -> None:
    parts = [f"part 1 1 0 0 {part} 2 -" for part in range(2)]
    commands = [*running_board(), *parts[:made], f"output {sent_bytes}", "ended", *parts[made:], "skipped", "status"]
    before = run_commands([*commands, "log 4 20 6869", "output 1000"])
    assert before[-1] == "output "  # all that the next host gets before its first request
    identify = encode_packet(MessageType.IDENTIFY, 1)
    after = run_commands([*commands, f"receive 5 {identify.hex()}", f"frame 6 {'00' * 176}", "output 1000", "state"])
    answer, status, frame = found_in(after[len(before) - 2 :])
    assert (answer.type, status.type, frame.type) == (MessageType.IDENTITY, MessageType.STATUS, MessageType.FRAME)
    dropped = 2 - (made == 2 and sent_bytes == 72)
    assert (frame.sequence, decode_message(BoardStatus, status.payload).frames_dropped) == (2, dropped)
    assert after[-1].startswith(f"state running 1000 1 0 {dropped} ")


@pytest.mark.parametrize(
    "wrong", [{"boot_id": 0}, {"credit_bytes": 63}, {"credit_bytes": 8973}, {"queue_bytes": 0}, {"gate_ticks_step": 0}]
)
def test_unusable_setup_is_refused(wrong: dict[str, int]) -> None:
    identity = replace(IDENTITY, credit_bytes=wrong.get("credit_bytes", 64))
    description = replace(
        DESCRIPTION, queue_bytes=wrong.get("queue_bytes", CHUNK_BYTES), gate_ticks_step=wrong.get("gate_ticks_step", 1)
    )
    assert run_commands([board_command(identity, description, wrong.get("boot_id", 1))]) == ["bad"]


def test_output_against_a_model() -> None:
    commands: list[str] = []
    expected: list[str] = []
    seen: set[str] = set()
    for seed in range(400):
        rng = random.Random(seed)
        chunks = rng.choice((4, 7, 12, 30))
        description = replace(DESCRIPTION, queue_bytes=CHUNK_BYTES * chunks)
        model = Model(chunks)
        commands += [board_command(IDENTITY, description, BOOT_ID)]
        commands += [f"receive 0 {CONFIGURE.hex()}", f"receive 0 {START.hex()}", "begin"]
        commands += [f"receive 0 {CONFIGURE.hex()}", f"receive 0 {START.hex()}"]
        model.answer(MessageType.CONFIGURED, 1, encode_message(Configuration(1000)))
        model.answer(MessageType.STARTED, 2, b"")
        expected.append("ok")
        play(rng, model, commands, expected)
        commands.append("state")
        lost = f"{model.dropped + model.skipped} {model.parts_dropped} {model.answers_dropped}"
        expected.append(f"state running 1000 2 0 {lost}")
        seen |= {name for name in ("dropped", "skipped", "parts_dropped", "answers_dropped") if getattr(model, name)}
    printed = [line for line in run_commands(commands) if not line.startswith("packet")]
    check(expected, printed)
    assert seen == {"dropped", "skipped", "parts_dropped", "answers_dropped"}


def play(rng: random.Random, model: Model, commands: list[str], expected: list[str]) -> None:
    parts, part = 0, 0
    for ticks in range(1, 60):
        draw = rng.random()
        if part < parts:
            body = rng.randbytes(12 * rng.randrange(12))
            commands.append(f"part {ticks} 1 5 {len(body) // 12} {part} {parts} {body.hex() or '-'}")
            model.ticks = ticks
            block = BLOCK_STRUCT.pack(1, 0, 5, len(body) // 12, part, parts)
            expected.append(f"queued {int(model.part(part, parts, block + body))}")
            part += 1
        elif draw < 0.3:
            records = rng.randbytes(176)
            commands.append(f"frame {ticks} {records.hex()}")
            model.ticks = ticks
            expected.append(f"queued {int(model.frame(records))}")
        elif draw < 0.4:
            parts, part = rng.randint(1, 6), 0
        elif draw < 0.5:
            commands.append("skipped")
            model.sequence += 1
            model.skipped += 1
        elif draw < 0.55:
            commands.append(f"log {ticks} 20 6869")
            model.ticks = ticks
            expected.append(f"queued {int(model.log(20, 'hi'))}")
        elif draw < 0.6:
            commands.append("status")
            model.status_due = True
        elif draw < 0.65:
            model.temperature = rng.randrange(400_000)
            commands.append(f"temperature {model.temperature}")
        if rng.random() < 0.3:
            opaque = rng.randbytes(8)
            commands.append(f"receive {ticks} {encode_packet(MessageType.PING, ticks, opaque).hex()}")
            model.ticks = ticks
            model.answer(MessageType.PONG, ticks, opaque)
        if rng.random() < 0.3:
            size = rng.choice((1, 30, 68, 200, 1000))
            commands.append(f"output {size}")
            expected.append(f"output {model.output(size).hex()}")
    while part < parts:  # a frame is finished
        commands.append(f"part 60 1 0 0 {part} {parts} -")
        model.ticks = 60
        expected.append(f"queued {int(model.part(part, parts, BLOCK_STRUCT.pack(1, 0, 0, 0, part, parts)))}")
        part += 1


def check(expected: list[str], printed: list[str]) -> None:
    for line, (ours, theirs) in enumerate(zip(expected, printed, strict=True)):
        same = theirs.startswith(ours) if ours.startswith("state") else theirs == ours
        assert same, f"line {line}: {ours}, not {theirs}"
