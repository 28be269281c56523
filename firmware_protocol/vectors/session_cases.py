"""Boards: bytes from the host, and what they answer."""

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


def board_sessions() -> list[Case]:
    ticks = 5000

    def answer(message_type: int, sequence: int, payload: bytes = b"") -> bytes:
        return packet(message_type, sequence, payload, ticks=ticks, boot_id=0x11223344)

    def asked(request: bytes, answers: list[bytes], state: str) -> Case:
        sends = [answer.hex() for answer in answers]
        return {"do": "receive", "ticks": ticks, "bytes": request.hex(), "sends": sends, "state": state}

    def with_numbers(message_type: int, sequence: int, numbers: dict[int, int]) -> Case:
        """Return a message whose texts are free: its header, and the numbers among its fields."""
        header = {"type": message_type, "sequence": sequence, "board_ticks": ticks, "boot_id": 0x11223344}
        return {**header, "numbers": {str(tag): value for tag, value in numbers.items()}}

    def refused(request: bytes, sequence: int, code: int, state: str) -> Case:
        return asked(request, [], state) | {"sends": [with_numbers(REFUSED, sequence, {1: code})]}

    def fault(text: str | None, state: str, sends: list[Case]) -> Case:
        return {"do": "fault", "ticks": ticks, "text": text, "state": state, "sends": sends}

    def session(name: str, steps: list[Case], *, capabilities: int = 0) -> Case:
        board = {**BOARD, "description": {**BOARD["description"], "capabilities": capabilities}}
        return {"name": name, "board": board, "steps": steps}

    gate = number(1, 20_000)
    configured = asked(packet(CONFIGURE, 3, gate), [answer(0x83, 3, gate)], "configured")
    started = asked(packet(START, 4), [answer(0x84, 4)], "running")
    records = bytes(range(176))

    def frame(sequence: int, when: int) -> Case:
        sends = packet(FRAME, sequence, records, ticks=when, boot_id=0x11223344)
        return {"do": "frame", "ticks": when, "records": records.hex(), "sends": [sends.hex()], "state": "running"}

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
            "more payload than this version knows",
            [
                asked(packet(IDENTIFY, 1, b"later"), [answer(0x81, 1, IDENTITY_PAYLOAD)], "idle"),
                asked(packet(CONFIGURE, 3, gate + number(77, 1)), [answer(0x83, 3, gate)], "configured"),
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
    ]
