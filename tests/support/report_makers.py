"""Makers of the messages of one plate, and messages as they are on the wire."""

import json
import math
from pathlib import Path
from typing import Any, TypeVar

from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config import Config
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.estimate.forces.readings import ForceReading
from resonator_daemon.measure.pipeline.state_messages import StateMessages
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.measure.sensors.force_messages import ForceMessages
from resonator_daemon.measure.sensors.output import MessageOutput, SensorState
from resonator_daemon.mqtt.codec import Encoded, decoded, encode
from resonator_daemon.mqtt.payloads import Contacts, Forces, Lost, Message
from resonator_daemon.mqtt.topics import Headers

MessageT = TypeVar("MessageT", bound=Message)

GATE_END_NS = 1_789_000_000_000_000_123


def gate_middle(gate_ns: int, *, later_ns: int = 0) -> Instant:
    """Return the middle of a gate that ended at GATE_END_NS, or later."""
    return Instant(GATE_END_NS + later_ns - gate_ns // 2, 42_000)


NAN = math.nan
LOST = {
    "link_gap": 1, "damaged": 2, "board_overflow": 3, "host_overrun": 4, "queue_overflow": 6, "publish_dropped": 5,
    "skipped_late": 7
}  # fmt: skip


class Losses:
    """Losses that grow while messages are made."""

    def __init__(self) -> None:
        self.now = Lost(**LOST)

    def __call__(self) -> Lost:
        return self.now


def configured(tmp_path: Path, plate: str, **tables: Any) -> Config:
    if "\n" in plate:
        path = tmp_path / "plate.toml"
        path.write_text(plate)
        plate = str(path)
    return Config.model_validate({"plate": plate, "link": "tcp://127.0.0.1:5000", **tables})


def read_whole(kind: type[MessageT], encoded: Encoded) -> MessageT:
    """Return a message that was encoded from its fields; it must have each of its model's, also those with a default.

    The encoder does not check that: it would cost time in each frame.
    """
    message = decoded(kind, encoded)
    assert json.loads(encoded.payload) == json.loads(message.model_dump_json())
    return message


class ReadForceMessages:
    """Messages about readings of force sites, as subscribers read them."""

    def __init__(self, plate: Plate, output: MessageOutput) -> None:
        self._made = ForceMessages(plate, output)
        self.event = self._made.event

    def forces(self, reading: ForceReading, gate_middle: Instant) -> Forces:
        header = self._made.header(reading, gate_middle)
        return read_whole(Forces, self._made.forces(header, reading, gate_middle))

    def contacts(self, reading: ForceReading, gate_middle: Instant) -> Contacts:
        header = self._made.header(reading, gate_middle)
        return read_whole(Contacts, self._made.contacts(header, reading, gate_middle))


class Messages:
    """What makes the messages of one plate."""

    def __init__(self, config: Config, losses: Losses | None = None, make_decoding: Any = lambda *_: None) -> None:
        self.headers = Headers("left-index", "9f3c", losses or Losses())
        self.headers.board_boot_id = "51aa"
        self.sensor: Any = sensor_of(config.plate, config.measurement, config.decoding)
        self.states = StateMessages(config, self.sensor, self.headers)
        self.published: list[tuple[str, Any]] = []
        state = SensorState(lambda *_: None, "")
        self.output = MessageOutput(
            config, self.headers, state, lambda t, m: self.published.append((t.path, m)), lambda _: False
        )
        self.sensor.connect(self.output, make_decoding)
        self.force = ReadForceMessages(config.plate, self.output)


def literal(message: Message) -> dict[str, Any]:
    payload: dict[str, Any] = json.loads(encode(message))
    return payload
