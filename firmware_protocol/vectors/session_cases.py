"""Boards: bytes from the host, and what they answer."""

from typing import Any

from firmware_protocol.vectors.wire import (
    CONFIGURE,
    FRAME,
    IDENTIFY,
    LOCATE,
    LOG,
    ONE,
    PING,
    PONG_ME,
    REFUSED,
    START,
    STATUS,
    STOP,
    TWO,
    Case,
    flipped,
    number,
    packet,
    text,
)

BOARD: Case = {
    "boot_id": 0x11223344,
    "identity": {
        "product": "demo",
        "serial_number": "0042",
        "firmware": "1.0",
        "protocol_minor": 0,
        "credit_bytes": 64,
        "reset_cause": 1,
    },
    "description": {
        "counter_kind": 0,
        "channels": 4,
        "tones": 1,
        "reference_millihertz": 10**12,
        "gate_ticks_min": 1000,
        "gate_ticks_max": 1_000_000,
        "plate": "quartz16",
        "oscillator_millihertz": 0,
        "oscillator_spacing_millihertz": 0,
        "queue_bytes": 4352,
        "capabilities": 0,
        "gate_ticks_step": 10,
    },
}
IDENTITY_PAYLOAD = text(1, "demo") + text(2, "0042") + text(3, "1.0") + number(4, 0) + number(5, 64) + number(6, 1)
DESCRIPTION_PAYLOAD = b"".join(
    (
        number(1, 0),
        number(2, 4),
        number(3, 1),
        number(4, 10**12),
        number(5, 1000),
        number(6, 1_000_000),
        text(7, "quartz16"),
        number(8, 0),
        number(9, 0),
        number(10, 4352),
        number(11, 0),
        number(12, 10),
    )
)


SECOND = 10**9  # in ticks


def board_sessions() -> list[Case]:
    ticks = 5000

    def answer(message_type: int, sequence: int, payload: bytes = b"", when: int = ticks) -> bytes:
        return packet(message_type, sequence, payload, ticks=when, boot_id=0x11223344)

    def asked(request: bytes, answers: list[bytes], state: str, when: int = ticks) -> Case:
        sends = [answer.hex() for answer in answers]
        return {"do": "receive", "ticks": when, "bytes": request.hex(), "sends": sends, "state": state}

    def with_numbers(message_type: int, sequence: int | None, numbers: dict[int, int], when: int = ticks) -> Case:
        """Return a message whose texts are free: its header, its number if it is fixed, and numbers of its fields."""
        header = {"type": message_type} | ({} if sequence is None else {"sequence": sequence})
        header |= {"board_ticks": when, "boot_id": 0x11223344}
        return {**header, "numbers": {str(tag): value for tag, value in numbers.items()}}

    def refused(request: bytes, sequence: int, code: int, state: str, when: int = ticks) -> Case:
        return asked(request, [], state, when) | {"sends": [with_numbers(REFUSED, sequence, {1: code}, when)]}

    def fault(text: str | None, state: str, sends: list[Any], when: int = ticks) -> Case:
        return {"do": "fault", "ticks": when, "text": text, "state": state, "sends": sends}

    def session(name: str, steps: list[Case], *, capabilities: int = 0, queue_bytes: int = 4352) -> Case:
        changed = {"capabilities": capabilities, "queue_bytes": queue_bytes}
        return {"name": name, "board": {**BOARD, "description": {**BOARD["description"], **changed}}, "steps": steps}

    def connects(state: str, *, served: bool = True, when: int = ticks) -> Case:
        return {"do": "connect", "ticks": when, "served": served, "sends": [], "state": state}

    def disconnects(state: str) -> Case:
        return {"do": "disconnect", "sends": [], "state": state}

    gate_payload = number(1, 20_000)
    configured = asked(packet(CONFIGURE, 3, gate_payload), [answer(0x83, 3, gate_payload)], "configured")
    started = asked(packet(START, 4), [answer(0x84, 4)], "running")
    records = bytes(range(176))

    def frame_packet(sequence: int, when: int) -> str:
        return packet(FRAME, sequence, records, ticks=when, boot_id=0x11223344).hex()

    def gate(when: int, sends: list[Any]) -> Case:
        return {"do": "frame", "ticks": when, "records": records.hex(), "sends": sends, "state": "running"}

    def frame(sequence: int, when: int) -> Case:
        return gate(when, [frame_packet(sequence, when)])

    def cut_frame(sequence: int, when: int, takes: int) -> Case:
        return gate(when, [frame_packet(sequence, when)[: 2 * takes]]) | {"takes": takes}

    def reported_frame(sequence: int, when: int, notice: int, dropped: int) -> Case:
        return gate(when, [with_numbers(STATUS, notice, {1: dropped}, when), frame_packet(sequence, when)])

    def skip(when: int) -> Case:
        return {"do": "skip", "ticks": when, "sends": [], "state": "running"}

    def identified(when: int, state: str) -> Case:
        return asked(ONE, [answer(0x81, 1, IDENTITY_PAYLOAD, when)], state, when)

    return [
        session(
            "from asking to counting and back",
            [
                asked(ONE, [answer(0x81, 1, IDENTITY_PAYLOAD)], "idle"),
                asked(TWO, [answer(0x82, 2, DESCRIPTION_PAYLOAD)], "idle"),
                configured,
                started,
                frame(0, 25_000),
                asked(PONG_ME, [answer(0x86, 9, b"12345678")], "running"),
                frame(1, 45_000),
                asked(packet(STOP, 10), [answer(0x85, 10)], "configured"),
                asked(packet(START, 11), [answer(0x84, 11)], "running"),
                frame(0, 99_000),
            ],
        ),
        session(
            "a repeated request is answered again and has no second effect",
            [configured, configured, started, frame(0, 25_000), started, frame(1, 45_000), configured, configured],
        ),
        session(
            "a request cut in three",
            [
                asked(ONE[:1], [], "idle"),
                asked(ONE[1:23], [], "idle"),
                asked(
                    ONE[23:] + TWO, [answer(0x81, 1, IDENTITY_PAYLOAD), answer(0x82, 2, DESCRIPTION_PAYLOAD)], "idle"
                ),
            ],
        ),
        session(
            "refusals",
            [
                refused(packet(START, 1), 1, 3, "idle"),
                refused(packet(0x2A, 2, b"?"), 2, 2, "idle"),
                refused(packet(LOCATE, 3), 3, 2, "idle"),
                refused(packet(CONFIGURE, 4), 4, 1, "idle"),
                refused(packet(CONFIGURE, 5, number(1, 999)), 5, 4, "idle"),
                refused(packet(CONFIGURE, 6, number(1, 2**64 - 1)), 6, 4, "idle"),
                refused(packet(CONFIGURE, 7, number(1, 1005)), 7, 4, "idle"),
                refused(packet(CONFIGURE, 7, number(1, 0)), 7, 4, "idle"),
                refused(packet(CONFIGURE, 7, number(1, 1_000_001)), 7, 4, "idle"),
                refused(packet(PING, 8, b"1234567"), 8, 1, "idle"),
                refused(packet(PING, 9), 9, 1, "idle"),
                refused(packet(IDENTIFY, 10, major=2), 10, 6, "idle"),
            ],
        ),
        session(
            "a refused CONFIGURE does not end a run",
            [
                configured,
                started,
                refused(packet(CONFIGURE, 5, number(1, 5)), 5, 4, "running"),
                frame(0, 25_000),
            ],
        ),
        session(
            "the shortest and the longest gate",
            [
                asked(packet(CONFIGURE, 1, number(1, length)), [answer(0x83, 1, number(1, length))], "configured")
                for length in (1000, 1_000_000)
            ],
        ),
        session(
            "after a START, queued answers are sent, and queued frames of the last run are not",
            [
                configured,
                started,
                cut_frame(0, 25_000, takes=0),
                asked(packet(STOP, 5), [], "configured", 30_000) | {"takes": 0},
                asked(
                    packet(START, 6), [answer(0x85, 5, when=30_000), answer(0x84, 6, when=35_000)], "running", 35_000
                ),
                frame(0, 55_000),
            ],
        ),
        session(
            "more payload than this version knows",
            [
                asked(packet(IDENTIFY, 1, b"later"), [answer(0x81, 1, IDENTITY_PAYLOAD)], "idle"),
                asked(
                    packet(CONFIGURE, 3, gate_payload + number(77, 1)), [answer(0x83, 3, gate_payload)], "configured"
                ),
                asked(packet(START, 4, b"!"), [answer(0x84, 4)], "running"),
            ],
        ),
        session(
            "noise, echo and other versions are not answered",
            [
                asked(b"noise\xa5", [], "idle"),
                asked(packet(0x81, 1, IDENTITY_PAYLOAD), [], "idle"),
                asked(packet(0x81, 1, major=2), [], "idle"),
                asked(flipped(ONE, 27), [], "idle"),
                asked(packet(PING, 1, bytes(37)), [], "idle"),
                asked(ONE, [answer(0x81, 1, IDENTITY_PAYLOAD)], "idle"),
            ],
        ),
        session(
            "a board that can make itself seen",
            [asked(packet(LOCATE, 3), [answer(0x87, 3)], "idle"), asked(packet(LOCATE, 3), [answer(0x87, 3)], "idle")],
            capabilities=2,
        ),
        session(
            "a host begins afresh",
            [
                configured,
                started,
                asked(ONE[:11], [], "running"),
                {"do": "begin", "state": "idle", "sends": []},
                refused(packet(START, 1), 1, 3, "idle"),
            ],
        ),
        session(
            "a board that cannot count",
            [
                fault("reference not locked", "idle", []),
                refused(packet(START, 1), 1, 3, "idle"),
                configured,
                refused(packet(START, 4), 4, 5, "configured"),
            ],
        ),
        session(
            "a fault ends a run, which begins again when it is over",
            [
                asked(ONE, [answer(0x81, 1, IDENTITY_PAYLOAD)], "idle"),
                configured,
                started,
                frame(0, 25_000),
                fault("reference not locked", "configured", [with_numbers(LOG, 0, {1: 40})]),
                fault("reference not locked", "configured", []),
                refused(packet(START, 5), 5, 5, "configured"),
                asked(PONG_ME, [answer(0x86, 9, b"12345678")], "configured"),
                fault(None, "configured", []),
                asked(packet(START, 6), [answer(0x84, 6)], "running"),
                frame(0, 99_000),
            ],
        ),
        session(
            "a new connection changes no state, and discards a request that has begun",
            [
                connects("idle"),
                asked(packet(PING, 1, bytes(36))[:30], [], "idle"),
                disconnects("idle"),
                connects("idle"),
                identified(ticks, "idle"),
                refused(packet(START, 2), 2, 3, "idle"),
                configured,
                disconnects("configured"),
                connects("configured"),
                started,
            ],
        ),
        session(
            "a run goes on after its connection, and the next host gets nothing before its first request",
            [
                connects("idle"),
                configured,
                started,
                frame(0, 25_000),
                disconnects("running"),
                gate(45_000, []),
                connects("running", when=50_000),
                gate(65_000, []),
                asked(b"noise", [], "running", 70_000),
                refused(packet(IDENTIFY, 7, major=2), 7, 6, "running", 75_000),
                gate(85_000, []),
                identified(90_000, "running"),
                reported_frame(4, 105_000, 0, dropped=3),
            ],
        ),
        session(
            "a frame that the end of a connection cuts off counts as dropped, with all queued frames",
            [
                connects("idle"),
                configured,
                started,
                frame(0, 25_000),
                cut_frame(1, 45_000, takes=203),
                cut_frame(2, 65_000, takes=0),
                disconnects("running"),
                connects("running", when=70_000),
                identified(75_000, "running"),
                reported_frame(3, 85_000, 0, dropped=2),
            ],
        ),
        session(
            "STATUS goes before each frame that follows another drop, however soon, and before no other",
            [
                configured,
                started,
                frame(0, 25_000),
                skip(45_000),
                reported_frame(2, 65_000, 0, dropped=1),
                skip(85_000),
                skip(105_000),
                reported_frame(5, 125_000, 1, dropped=3),
                frame(6, 145_000),
                skip(165_000),
                reported_frame(8, 185_000, 2, dropped=4),
            ],
        ),
        session(
            "a host is replaced 10 s after its last byte, of a packet or not, or after it connected",
            [
                connects("idle"),
                connects("idle", served=False, when=ticks + 10 * SECOND - 1),
                asked(b"noise", [], "idle", ticks + 10 * SECOND - 1),
                connects("idle", served=False, when=ticks + 20 * SECOND - 2),
                connects("idle", when=ticks + 20 * SECOND - 1),
                connects("idle", served=False, when=ticks + 30 * SECOND - 2),
                connects("idle", when=ticks + 30 * SECOND - 1),
            ],
        ),
        session(
            "frames in a full queue make room for the LOG of a fault",
            [
                configured,
                started,
                cut_frame(0, 25_000, takes=0),
                cut_frame(1, 45_000, takes=0),
                fault(
                    "why " * 15,
                    "configured",
                    [
                        with_numbers(STATUS, None, {1: 1}, 50_000),
                        frame_packet(1, 45_000),
                        with_numbers(LOG, None, {1: 40}, 50_000),
                    ],
                    50_000,
                ),
                refused(packet(START, 5), 5, 5, "configured", 55_000),
            ],
            queue_bytes=7 * 68,
        ),
        session(
            "a fault without a host is not logged: its reason comes with the next START",
            [
                connects("idle"),
                configured,
                started,
                disconnects("running"),
                fault("reference not locked", "configured", [], 10_000),
                connects("configured", when=15_000),
                identified(20_000, "configured"),
                refused(packet(START, 5), 5, 5, "configured", 25_000),
            ],
        ),
    ]
