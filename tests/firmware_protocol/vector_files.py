"""The vectors, read for the tests of both implementations."""

import json
from pathlib import Path
from typing import Any

import firmware_protocol.packets as packets_module
from firmware_protocol.messages import Description, Identity
from firmware_protocol.packets import Damage, Defect, ForeignVersion, Packet

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


def board_of(case: dict[str, Any]) -> tuple[Identity, Description, int]:
    board = case["board"]
    return Identity(**board["identity"]), Description(**board["description"]), board["boot_id"]
