"""The example of docs/examples/mosquitto, run as it is: what it lets each role do, and what it denies."""

import re
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import trustme
from brokers import Mosquitto, free_port
from mqtt_helpers import password_line, until
from paho.mqtt.client import topic_matches_sub
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import FAILURE, MQTT_5, BrokerConnection
from resonator_daemon.mqtt.codec import Incoming, Outgoing
from resonator_daemon.mqtt.connecting import BrokerError
from resonator_daemon.mqtt.topics import TOPICS

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "mosquitto"
PASSWORD = "open sesame"

OUTPUTS = {path for topic in TOPICS.values() for path in (topic.path, *([topic.slow_path] if topic.slow_hz else []))}
PLATE = {*OUTPUTS, "schema", "cmd/tare", "rsp/tare", "rsp/tare/1"}
DECODED = {"contacts", "contacts/20hz", "contacts/event", "decoded", "decoded/5hz"} | {
    "decoded/summary",
    "decoded/summary/20hz",
}
DECODER = {"resonator/decoder/a/state", "resonator/decoder/a/health"}
EVERYTHING = (
    {f"resonator/{name}/{path}" for name in ("left", "right") for path in PLATE}
    | DECODER
    | {"resonator/decoder/forces", "resonator", "resonator/left", "elsewhere/left/forces"}
)


def below(*names: str, paths: set[str]) -> set[str]:
    return {f"resonator/{name}/{path}" for name in names for path in paths}


BOTH = ("left", "right")
WRITES = {
    "left": below("left", paths=PLATE - {"cmd/tare"}),
    "decoder": below(*BOTH, paths=DECODED) | DECODER,
    "operator": below(*BOTH, paths={"cmd/tare"}),
    "subscriber": set(),
    "nobody": set(),
}
READS = {
    "left": below("left", paths={"cmd/tare", "info", "schema", "state/daemon", "state/link", "state/sensor"}),
    "decoder": below(*BOTH, paths={"signals", "info", "state/daemon", "state/link", "state/sensor"})
    | {"resonator/decoder/a/state"},
    "operator": {topic for topic in EVERYTHING if topic.startswith("resonator")},
    "subscriber": (below(*BOTH, "decoder", paths=PLATE - {"cmd/tare", "rsp/tare", "rsp/tare/1"}) & EVERYTHING)
    | DECODER,
    "nobody": set(),
}
DOORS = [
    ("left", "certificates"), ("left", "this computer"), ("decoder", "people"), ("operator", "people"),
    ("subscriber", "people"), ("nobody", "people")
]  # fmt: skip


@dataclass
class Plates:
    """The example's broker, and how each role gets in."""

    mosquitto: Mosquitto
    ports: dict[str, int]
    directory: Path
    clients: AsyncExitStack = field(default_factory=AsyncExitStack)

    def way_in(self, name: str, door: str) -> Mqtt:
        url = f"mqtt{'' if door in ('this computer', 'tests') else 's'}://localhost:{self.ports[door]}"
        files = {"ca_file": str(self.directory / "ca.crt")} if url.startswith("mqtts") else {}
        if door == "certificates":
            pair = {"certificate_file": str(self.directory / "left.crt"), "key_file": str(self.directory / "left.key")}
            return Mqtt(url=url, **files, **pair)
        if door == "tests":
            return Mqtt(url=url)
        return Mqtt(url=url, username=name, password_file=str(self.directory / "password"), **files)

    async def client(self, name: str, door: str, will: str | None = None, identifier: str | None = None) -> "Client":
        client = Client(self.way_in(name, door), will, identifier)
        await client.connect()
        self.clients.push_async_callback(client.disconnect)
        return client


class Client(BrokerConnection):
    """Remembers what it got, and what the broker refused to take."""

    def __init__(self, broker: Mqtt, will: str | None, identifier: str | None) -> None:
        self.got: list[Incoming] = []
        self.refused: dict[str, bool] = {}
        super().__init__(
            broker,
            MQTT_5,
            identifier=identifier,
            will=Outgoing(will, b"will") if will else None,
            on_message=self.got.append,
            on_completed=lambda sent, code: self.refused.update({str(sent.token): code >= FAILURE}),
        )

    async def send_all(self, topics: set[str], *, retain: bool = False) -> set[str]:
        """Send to each topic, and return those that the broker took."""
        self.refused.clear()
        for topic in sorted(topics):
            await until(lambda: self.writable and len(self.in_flight) < 10)
            self.send(topic, b"x", qos=1, retain=retain, token=topic)
        await until(lambda: len(self.refused) == len(topics))
        return {topic for topic, refused in self.refused.items() if not refused}


@asynccontextmanager
async def plates_broker(directory: Path) -> AsyncIterator[Plates]:
    """The example with ports, paths and certificates of its own, and one more door, without rules, for the tests."""
    authority = trustme.CA()
    authority.cert_pem.write_to_path(directory / "ca.crt")
    for name, made in (
        ("broker", authority.issue_cert("localhost")),
        ("left", authority.issue_cert(common_name="left")),
    ):
        made.private_key_pem.write_to_path(directory / f"{name}.key")
        made.cert_chain_pems[0].write_to_path(directory / f"{name}.crt")
    (directory / "password").write_text(PASSWORD)
    (directory / "password").chmod(0o600)
    people = ("decoder", "operator", "subscriber", "nobody")
    (directory / "passwords-people").write_text("".join(password_line(name, PASSWORD) for name in people))
    (directory / "passwords-plates").write_text(password_line("left", PASSWORD))
    for name in ("acl-plates", "acl-people"):
        (directory / name).write_text((EXAMPLE / name).read_text())
    ports = {door: free_port() for door in ("certificates", "people", "this computer", "tests")}
    text = (EXAMPLE / "mosquitto.conf").read_text().replace("/etc/mosquitto/plates/", f"{directory}/")
    for port, door in (("8883", "certificates"), ("8884", "people"), ("1883", "this computer")):
        text, changed = re.subn(rf"^listener {port}\b", f"listener {ports[door]}", text, flags=re.MULTILINE)
        assert changed == 1
    text += f"listener {ports['tests']} 127.0.0.1\nallow_anonymous true\n"
    plates = Plates(Mosquitto(directory, config=text), ports, directory)
    async with plates.mosquitto, plates.clients:
        yield plates


@pytest.fixture
async def plates(tmp_path: Path) -> AsyncIterator[Plates]:
    async with plates_broker(tmp_path) as running:
        yield running


@pytest.mark.parametrize(("name", "door"), DOORS)
async def test_what_a_role_may_write(name: str, door: str, plates: Plates) -> None:
    client = await plates.client(name, door)
    assert await client.send_all(EVERYTHING) == WRITES[name]


@pytest.mark.parametrize("topic_filter", ["#", "resonator/#"])
@pytest.mark.parametrize(("name", "door"), DOORS)
async def test_what_a_role_may_read(name: str, door: str, topic_filter: str, plates: Plates) -> None:
    """Retained messages when it subscribes, and those that come; sent by one whom no rule binds."""
    source = await plates.client("", "tests")
    assert await source.send_all(EVERYTHING, retain=True) == EVERYTHING
    client = await plates.client(name, door)
    await client.subscribe(topic_filter, qos=1)
    await source.send_all(EVERYTHING)
    await client.subscribe("later", qos=1)  # answered after everything that the broker had for this client before
    reads = {topic for topic in READS[name] if topic_matches_sub(topic_filter, topic)}
    assert {message.topic for message in client.got if message.retained} == reads
    assert {message.topic for message in client.got if not message.retained} == reads


@pytest.mark.parametrize(("name", "door"), [("operator", "this computer"), ("left", "people"), ("left", "nobody")])
async def test_a_name_of_another_door_does_not_get_in(name: str, door: str, plates: Plates) -> None:
    broker = plates.way_in(name, "people").anonymous() if door == "nobody" else plates.way_in(name, door)
    with pytest.raises(BrokerError) as refused:
        await Client(broker, None, None).connect()
    assert refused.value.code == ReasonCode(PacketTypes.CONNACK, "Not authorized").value
