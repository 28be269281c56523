"""PROTOCOL.md prints the tables and the bytes that the code uses, and no others."""

import re
from collections.abc import Iterable
from dataclasses import replace
from enum import IntEnum
from pathlib import Path

import pytest
from c_reference import board_command, run_commands

from firmware_protocol import messages
from firmware_protocol.device import DeviceSession
from firmware_protocol.layouts import (
    BLOCK_FIELDS,
    BLOCK_STRUCT,
    FROM_BOARD,
    SINGLE_TONE_FIELDS,
    SINGLE_TONE_STRUCT,
    TONE_FIELDS,
    TONE_STRUCT,
    BlockEncoding,
    Capability,
    Field,
    MessageType,
    RecordFlag,
    SingleToneRecord,
    ToneFlag,
    struct_of,
)
from firmware_protocol.packets import Packet, PacketDecoder, encode_packet
from firmware_protocol.states import BOARD, HOST, BoardState, Cue, HostState
from resonator_daemon.board.config.tables import plate_name

PAGE = Path(messages.__file__).with_name("PROTOCOL.md").read_text()

HEADER_FIELDS = (
    Field("sync", "H"), Field("version", "B"), Field("type", "B"), Field("sequence", "I"),
    Field("board_ticks", "Q"), Field("boot_id", "I"), Field("length", "H"), Field("header_check", "H")
)  # fmt: skip


def table(heading: str) -> list[list[str]]:
    """Return the rows of the first table under a heading, without its head."""
    section = re.split(rf"^#+ {re.escape(heading)}$", PAGE, maxsplit=1, flags=re.MULTILINE)[1]
    lines = [line for line in re.split(r"^#", section, maxsplit=1, flags=re.MULTILINE)[0].split("\n\n") if "|" in line]
    return [[cell.strip() for cell in row.strip("| \n").split(" |")] for row in lines[0].strip().split("\n")[2:]]


def byte_rows(fields: tuple[Field, ...]) -> list[list[str]]:
    sizes = [struct_of((field,)).size for field in fields]
    return [
        [str(sum(sizes[:at])), str(size), field.name]
        for at, (field, size) in enumerate(zip(fields, sizes, strict=True))
    ]


def heads(rows: Iterable[list[str]], cells: int) -> list[list[str]]:
    return [row[:cells] for row in rows]


@pytest.mark.parametrize(
    ("heading", "fields"),
    [
        ("Byte table of a packet", HEADER_FIELDS),
        ("6. FRAME: single-tone counter", SINGLE_TONE_FIELDS),
        ("Head of a part", BLOCK_FIELDS),
        ("A tone", TONE_FIELDS),
    ],
)
def test_byte_tables(heading: str, fields: tuple[Field, ...]) -> None:
    assert heads(table(heading), 3)[: len(fields)] == byte_rows(fields)
    assert len(table(heading)) == len(fields) + 2 * (fields is HEADER_FIELDS)  # a packet has a payload and a CRC, too


def test_message_table() -> None:
    expected = [[f"0x{member:02X}", member.name, "board" if member & FROM_BOARD else "host"] for member in MessageType]
    assert sorted(heads(table("3. Messages"), 3)) == sorted(expected)


@pytest.mark.parametrize("kind", messages.MESSAGE_FIELDS, ids=lambda kind: kind.__name__)
def test_field_tables(kind: type) -> None:
    headings = {
        messages.Identity: "IDENTITY",
        messages.Description: "DESCRIPTION",
        messages.Configuration: "CONFIGURE and CONFIGURED",
        messages.BoardStatus: "STATUS",
        messages.BoardLog: "LOG",
        messages.Refusal: "REFUSED",
    }
    expected = [
        [
            str(field.tag),
            field.name,
            "text" if field.is_text else "number",
            "may be absent" if field.name in messages.OPTIONAL_FIELDS[kind] else "always",
        ]
        for field in messages.MESSAGE_FIELDS[kind]
    ]
    assert heads(table(headings[kind]), 4) == expected


@pytest.mark.parametrize(("heading", "kind"), [("Flags of a record", RecordFlag), ("Flags of a tone", ToneFlag)])
def test_flag_tables(heading: str, kind: type[IntEnum]) -> None:
    assert heads(table(heading), 2) == [[str(member.value), words(member)] for member in kind]


def test_other_numbers() -> None:
    kinds = {
        "code": messages.RefusalCode,
        "reset_cause": messages.ResetCause,
        "counter_kind": messages.CounterKind,
        "capabilities": Capability,
        "encoding": BlockEncoding,
    }
    expected = [[name, str(member.value), words(member)] for name, kind in kinds.items() for member in kind]
    assert heads(table("Numbers"), 3) == expected
    assert table("LOG")[0][4] == ", ".join(f"{level} {words(level)}" for level in messages.LogLevel)


def words(member: IntEnum) -> str:
    return member.name.lower().replace("_", " ")


def board_cell(state: BoardState, request: MessageType) -> str:
    reaction = BOARD[state, request]
    answer = reaction.answer.name if reaction.refusal is None else f"REFUSED {reaction.refusal}"
    return answer if reaction.next_state is state else f"{answer}, to {reaction.next_state.value}"


def test_states_of_a_board() -> None:
    requests = [member for member in MessageType if not member & FROM_BOARD]
    assert set(BOARD) == {(state, request) for state in BoardState for request in requests}
    page = table("States of a board")
    assert [row[0] for row in page] == [request.name for request in requests]
    assert page == [[request.name, *(board_cell(state, request) for state in BoardState)] for request in requests]


def names(states: list[HostState]) -> str:
    return "any" if len(states) == len(HostState) else ", ".join(state.value for state in states)


def host_rows() -> list[list[str]]:
    """One row for all states that a cue takes to one state, or leaves where they are."""
    rows = []
    for cue in Cue:
        steps = {state: step for (state, of), step in HOST.items() if of is cue}
        one_target = len({step.next_state for step in steps.values()}) == 1
        groups: dict[tuple[str, str], list[HostState]] = {}
        for state in HostState:
            if (step := steps.get(state)) is not None:
                target = "stays" if step.next_state is state and not one_target else step.next_state.value
                groups.setdefault((target, step.sends.name if step.sends else "nothing"), []).append(state)
        rows += [[names(states), cue.value, target, sends] for (target, sends), states in groups.items()]
    return rows


def test_states_of_a_host() -> None:
    assert table("States of a host") == host_rows()


BOOT = 0x11223344
DESCRIPTION = messages.Description(
    messages.CounterKind.SINGLE_TONE, 4, 1, 10**12, 10**5, 10**8, "quartz16", 0, 0, 16_384, Capability.LOCATE, 1
)
STAMPS = (100, 1100, 2101, 3101)  # of every tenth edge, from edge 1000 on
RECORD = SingleToneRecord(
    first_edge=1000,
    first_ticks=STAMPS[0],
    stamps=len(STAMPS),
    stride_edges=10,
    span_ticks=STAMPS[-1] - STAMPS[0],
    s1_ticks=sum(stamp - STAMPS[0] for stamp in STAMPS),
    s2_ticks=sum(k * (stamp - STAMPS[0]) for k, stamp in enumerate(STAMPS)),
    q2_ticks2=sum((c - 2 * b + a) ** 2 for a, b, c in zip(STAMPS, STAMPS[1:], STAMPS[2:], strict=False)),
    attenuation_db256=0x300,
    flags=0,
)


def board(message_type: MessageType, sequence: int, payload: bytes, board_ticks: int) -> bytes:
    return encode_packet(message_type, sequence, payload, board_ticks=board_ticks, boot_id=BOOT)


def examples() -> dict[str, bytes]:
    """Every message once, in the order of a session."""
    session = DeviceSession(messages.Identity("demo", "0042", "1.0", 0), DESCRIPTION, BOOT)
    sent: dict[str, bytes] = {}

    def ask(name: str, answer: str, request: MessageType, number: int, payload: bytes, ticks: int) -> None:
        sent[name] = encode_packet(request, number, payload)
        sent[answer] = session.receive(sent[name], ticks)

    gate = messages.encode_message(messages.Configuration(10**6))
    ask("IDENTIFY", "IDENTITY", MessageType.IDENTIFY, 1, b"", 1000)
    ask("DESCRIBE", "DESCRIPTION", MessageType.DESCRIBE, 2, b"", 2000)
    ask("PING", "PONG", MessageType.PING, 3, bytes(range(1, 9)), 3000)
    ask("CONFIGURE", "CONFIGURED", MessageType.CONFIGURE, 4, gate, 4000)
    ask("START", "STARTED", MessageType.START, 5, b"", 5000)
    sent["FRAME"] = session.frame(0, 1_005_000, SINGLE_TONE_STRUCT.pack(*RECORD) * 4)
    tones = TONE_STRUCT.pack(-1, 65_536, 0x300, 120, 0) + TONE_STRUCT.pack(0, 0, 0, 0, ToneFlag.NO_SIGNAL)
    sent["FRAME_PART"] = board(
        MessageType.FRAME_PART, 7, BLOCK_STRUCT.pack(3, BlockEncoding.TONE_12, 2232, 2, 19, 20) + tones, 9_000_000
    )
    sent["STATUS"] = session.status(messages.BoardStatus(258, 298_150, 3), 2_000_000)
    sent["LOG"] = session.log(messages.BoardLog(30, "reference unlocked"), 2_000_001)
    ask("LOCATE", "LOCATED", MessageType.LOCATE, 6, b"", 2_000_002)
    ask("STOP", "STOPPED", MessageType.STOP, 7, b"", 2_000_003)
    sent["REFUSED"] = session.receive(
        encode_packet(MessageType.CONFIGURE, 8, messages.encode_message(messages.Configuration(1))), 2_000_004
    )
    return sent


def test_examples_are_what_the_code_sends() -> None:
    printed: dict[str, bytes] = {}
    for name, data in re.findall(r"^    (\w*) +((?:[0-9A-F]{2} ?)+)$", PAGE.split("## 11. Examples")[1], re.MULTILINE):
        last = name or list(printed)[-1]
        printed[last] = printed.get(last, b"") + bytes.fromhex(data)
    assert printed == examples()
    assert set(printed) == {member.name for member in MessageType}


@pytest.mark.parametrize(
    ("serial_number", "sound"),
    [
        ("RD-0042", True), ("a_b.c-9", True), ("x" * 63, True), ("x" * 64, False), ("", False), (".", False),
        ("a/b", False), ("a+", False), ("é", False)
    ],
)  # fmt: skip
def test_serial_numbers(serial_number: str, sound: bool) -> None:
    identity = messages.Identity("demo", serial_number, "1.0", 0, 64)
    assert made_in_python(identity, DESCRIPTION) is sound
    assert made_in_c(identity, DESCRIPTION) is sound
    if sound:
        assert plate_name(serial_number) == serial_number  # the daemon uses it as a level of topics


@pytest.mark.parametrize(
    ("changes", "sound"),
    [
        ({"gate_ticks_max": 2**32 - 1}, True),
        ({"gate_ticks_max": 2**32}, False),
        ({"counter_kind": 1, "tones": 46_872}, True),
        ({"counter_kind": 1, "tones": 46_873}, False),
    ],
)
def test_limits_of_a_description(changes: dict[str, int], sound: bool) -> None:
    identity = messages.Identity("demo", "0042", "1.0", 0, 64)
    description = replace(DESCRIPTION, **changes)  # type: ignore[arg-type]
    assert made_in_python(identity, description) is sound
    assert made_in_c(identity, description) is sound


def test_the_longest_frame_has_63_parts_on_each_channel() -> None:
    device = DeviceSession(messages.Identity("demo", "0042", "1.0", 0), DESCRIPTION, BOOT)
    parts = PacketDecoder(from_board=True).feed(device.frame_parts(0, 0, [bytes(12 * 46_872)] * 4))
    assert len(parts) == 4 * 63
    assert max(part.size_bytes for part in parts if isinstance(part, Packet)) == 8964


def made_in_python(identity: messages.Identity, description: messages.Description) -> bool:
    try:
        DeviceSession(identity, description, BOOT)
    except ValueError:
        return False
    return True


def made_in_c(identity: messages.Identity, description: messages.Description) -> bool:
    return run_commands([board_command(identity, description, BOOT)]) == ["ok"]
