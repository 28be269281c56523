"""Values of both checks, and lists of fields."""

from collections.abc import Mapping

from firmware_protocol.vectors.wire import Case, number, text

Values = Mapping[str, int | str]


def checks() -> list[Case]:
    """Check values of the catalogue of parametrised CRC algorithms (CRC-16/IBM-3740 and CRC-32/ISO-HDLC)."""
    nine = b"123456789".hex()
    return [
        {"check": "header_check", "bytes": nine, "value": 0x29B1},
        {"check": "crc", "bytes": nine, "value": 0xCBF43926},
        {"check": "header_check", "bytes": "", "value": 0xFFFF},
        {"check": "crc", "bytes": "", "value": 0},
    ]


def messages() -> list[Case]:
    """Payloads that are lists of fields; `canonical`: an encoder makes the same bytes of these values."""

    def sound(name: str, message: str, payload: bytes, fields: Values, *, canonical: bool = True) -> Case:
        return {"name": name, "message": message, "payload": payload.hex(), "fields": fields, "canonical": canonical}

    def malformed(name: str, message: str, payload: bytes) -> Case:
        return {"name": name, "message": message, "payload": payload.hex(), "malformed": True}

    gate = {"gate_ticks": 1_000_000}
    million = bytes((1, 3, 0x40, 0x42, 0x0F))
    return [
        sound("a number in as few bytes as it needs", "CONFIGURE", million, gate),
        sound("nought needs a byte", "CONFIGURE", bytes((1, 1, 0)), {"gate_ticks": 0}),
        sound("largest number", "CONFIGURE", bytes((1, 8)) + b"\xff" * 8, {"gate_ticks": 2**64 - 1}),
        sound(
            "leading noughts",
            "CONFIGURE",
            bytes((1, 8)) + (7).to_bytes(8, "little"),
            {"gate_ticks": 7},
            canonical=False,
        ),
        sound(
            "unknown fields before and behind",
            "CONFIGURE",
            bytes((9, 0)) + million + bytes((200, 2, 1, 1)),
            gate,
            canonical=False,
        ),
        sound("the last of two counts", "CONFIGURE", bytes((1, 1, 7)) + million, gate, canonical=False),
        malformed("empty", "CONFIGURE", b""),
        malformed("a tag without size", "CONFIGURE", b"\x01"),
        malformed("a value cut off", "CONFIGURE", million[:-1]),
        malformed("an unknown field cut off", "CONFIGURE", million + bytes((9, 4, 0))),
        malformed("a number of no bytes", "CONFIGURE", bytes((1, 0))),
        malformed("a number of nine bytes", "CONFIGURE", bytes((1, 9)) + bytes(9)),
        malformed("only an unknown field", "CONFIGURE", bytes((2, 1, 0))),
        sound(
            "who the board is",
            "IDENTITY",
            text(1, "demo") + text(2, "0042") + text(3, "1.0") + number(4, 0) + number(5, 256) + number(6, 3),
            {
                "product": "demo",
                "serial_number": "0042",
                "firmware": "1.0",
                "protocol_minor": 0,
                "credit_bytes": 256,
                "reset_cause": 3,
            },
        ),
        sound(
            "absent fields have their defaults",
            "IDENTITY",
            text(1, "demo") + text(2, "0042") + text(3, "1.0") + number(4, 0),
            {
                "product": "demo",
                "serial_number": "0042",
                "firmware": "1.0",
                "protocol_minor": 0,
                "credit_bytes": 64,
                "reset_cause": 0,
            },
            canonical=False,
        ),
        malformed("a board without a serial number", "IDENTITY", text(1, "demo") + text(3, "1.0") + number(4, 0)),
        sound("drops alone", "STATUS", number(1, 258), {"frames_dropped": 258}),
        sound(
            "drops, temperature and noise",
            "STATUS",
            number(1, 0) + number(2, 298_150) + number(3, 17),
            {"frames_dropped": 0, "temperature_millikelvin": 298_150, "bytes_discarded": 17},
        ),
        sound("text beyond ASCII", "LOG", number(1, 30) + text(2, "20 °C"), {"level": 30, "text": "20 °C"}),
        sound("why not", "REFUSED", number(1, 5) + text(2, "no reference"), {"code": 5, "text": "no reference"}),
    ]
