"""The vectors, read for the tests of both implementations."""

import json
from pathlib import Path
from typing import Any

import firmware_protocol.packets as packets_module
from firmware_protocol.messages import Description, Identity
from firmware_protocol.packets import Damage, Defect, ForeignVersion, Packet, PacketDecoder

VECTORS = Path(packets_module.__file__).with_name("vectors")


def cases(name: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((VECTORS / f"{name}.json").read_text())
    return found


def named(case: dict[str, Any]) -> str:
    return str(case["name"])


def expected_events(case: dict[str, Any]) -> list[Packet | Damage | ForeignVersion]:
    return [_event(event) for event in case["events"]]


def _event(event: dict[str, Any]) -> Packet | Damage | ForeignVersion:
    match event["event"]:
        case "packet":
            payload = bytes.fromhex(event["payload"])
            return Packet(event["type"], event["sequence"], event["board_ticks"], event["boot_id"], payload)
        case "damage":
            return Damage(Defect(event["defect"]), event["size_bytes"])
        case _:
            return ForeignVersion(event["major"], event["type"], event["sequence"])


def check_sent(step: dict[str, Any], sent: bytes) -> None:
    """Compare sent bytes with a step's `sends`: packets in hexadecimal, and messages whose texts are free."""
    sends = step["sends"]
    if "takes" in step:  # which cuts the last one
        assert sent.hex() == "".join(sends)
        return
    found = PacketDecoder(from_board=True).feed(sent)
    assert sum(packet.size_bytes for packet in found if isinstance(packet, Packet)) == len(sent)
    for expected, packet in zip(sends, found, strict=True):
        assert isinstance(packet, Packet)
        if isinstance(expected, str):
            (whole,) = PacketDecoder(from_board=True).feed(bytes.fromhex(expected))
            assert packet == whole
        else:
            present = {name: getattr(packet, name) for name in expected if name != "numbers"}
            assert present | {"numbers": _numbers(packet.payload, expected["numbers"])} == expected


def _numbers(payload: bytes, tags: Any) -> dict[str, int]:
    """Return the numbers of a list of fields under these tags."""
    found, position = {}, 0
    while position < len(payload):
        tag, size = payload[position], payload[position + 1]
        if str(tag) in tags:
            found[str(tag)] = int.from_bytes(payload[position + 2 : position + 2 + size], "little")
        position += 2 + size
    return found


def board_of(case: dict[str, Any]) -> tuple[Identity, Description, int]:
    board = case["board"]
    return Identity(**board["identity"]), Description(**board["description"]), board["boot_id"]
