"""`resonatord bridge ros2` as another participant of DDS sees it, that has nothing but the definitions of ROS."""

import asyncio
import json
import os
import random
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brokers import Mosquitto, publish
from example_messages import NOW_NS, example, header

from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import Contacts, Decoded, Grid, Health, Info, Message, SiteInfo, State

pytest.importorskip("cyclonedds", reason="cyclonedds has wheels for x86-64 and Python up to 3.13 only")
LOOPBACK = (
    '<General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>'
    '<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer Address="127.0.0.1"/></Peers></Discovery>'
)
WRENCH, FORCES, CLOUD = ("rt/left_index/" + name for name in ("wrench", "forces", "decoded/cloud"))
FASTDDS = str(Path(__file__).parents[3] / "build" / "fastdds_reader")  # of fastdds_reader.cpp, by `make test-ros2`
READERS = [
    pytest.param((sys.executable, str(Path(__file__).with_name("ros2_reader.py"))), id="cyclone"),
    pytest.param((FASTDDS, "16"), id="fastdds", marks=pytest.mark.fastdds),
    pytest.param((FASTDDS, "24"), id="fastdds-humble", marks=pytest.mark.fastdds),  # bytes of the id of a node
]
Line = dict[str, Any]
OF_FORCES = example(Info, rates_hz={"forces": 200.0, "contacts": 200.0})
ONLINE = example(State, state="online", reason="all is well")


class Bridged:
    """A broker, the bridge, and what a participant in another process has found."""

    def __init__(self, broker: Mosquitto, lines: asyncio.StreamReader) -> None:
        self.broker, self._lines = broker, lines
        self.publications: dict[str, Line] = {}  # by topic
        self.nodes: list[Line] = []

    async def until(self, right: Callable[[Line], Any], **messages: Message) -> Line:
        """Return the first line that is right; publish the messages again each half second, `_` for `/`."""
        async with asyncio.timeout(60):
            line = asyncio.ensure_future(self._line())
            while True:
                for path, message in messages.items():
                    topic = f"resonator/left-index/{path.replace('_', '/')}"
                    await publish(self.broker.url, topic, encode(message))
                while (await asyncio.wait([line], timeout=0.5))[0]:
                    if right(line.result()):
                        return line.result()
                    line = asyncio.ensure_future(self._line())

    async def _line(self) -> Line:
        line: Line = json.loads(await self._lines.readline())
        if line["what"] == "ros_discovery_info":
            self.nodes = line["node_entities_info_seq"]
        elif line["what"] == "publication":
            self.publications = {topic: one for topic, one in self.publications.items() if one["key"] != line["key"]}
            if line["alive"]:
                self.publications[line["topic_name"]] = line
        return line


@pytest.fixture(params=READERS)
async def bridged(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> AsyncIterator[Bridged]:
    monkeypatch.setenv("CYCLONEDDS_URI", f"<CycloneDDS><Domain>{LOOPBACK}</Domain></CycloneDDS>")
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    domain = str(2 * random.randint(1, 49) + worker % 2)  # two workers never meet
    command = ("-m", "resonator_daemon.commands", "bridge", "ros2", "--url", mosquitto.url, "--domain-id", domain)
    humble = ("--humble",) if "24" in request.param else ()
    bridge = await asyncio.create_subprocess_exec(sys.executable, *command, *humble)
    reader = await asyncio.create_subprocess_exec(*request.param, domain, "left_index", stdout=PIPE, limit=2**24)
    assert reader.stdout is not None
    yield Bridged(mosquitto, reader.stdout)
    reader.kill()
    bridge.terminate()
    assert await bridge.wait() == 0
    await reader.wait()


def levels(line: Line) -> list[int]:
    return [one["level"] for one in line["status"]] if line["what"] == "rt/diagnostics" else []


async def test_topics_types_and_values_are_those_of_ros(bridged: Bridged) -> None:
    contacts = example(Contacts)
    (contact,) = contacts.contacts
    (x, y), newton = contact.position_m, contact.force_newton[2]
    await bridged.until(lambda line: line["what"] == "participant" and line["user_data"] == "enclave=/;")
    line = await bridged.until(lambda line: line["what"] == WRENCH, info=OF_FORCES, contacts=contacts)
    stamp = line["header"]["stamp"]
    assert (stamp["sec"] * 10**9 + stamp["nanosec"], line["header"]["frame_id"]) == (NOW_NS, "left_index")
    assert line["wrench"]["force"] == {"x": 0.0, "y": 0.0, "z": newton}
    assert line["wrench"]["torque"] == {"x": pytest.approx(y * newton), "y": pytest.approx(-x * newton), "z": 0.0}
    line = await bridged.until(lambda line: line["what"].endswith("contacts/wrench"), contacts=contacts)
    assert line["header"]["frame_id"] == "left_index_contact_0"
    assert line["wrench"]["torque"] == {"x": pytest.approx(0.0), "y": pytest.approx(0.0), "z": 0.0}
    # The published RIHS01 hash of WrenchStamped, as `ros2 topic info --verbose` shows it.
    wrench_hash = "typehash=RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77;"
    assert bridged.publications[WRENCH]["user_data"] == wrench_hash
    types = {topic: one["type_name"] for topic, one in bridged.publications.items()}
    assert types[WRENCH] == "geometry_msgs::msg::dds_::WrenchStamped_"
    assert types["rt/tf"] == "tf2_msgs::msg::dds_::TFMessage_"
    assert types["rt/diagnostics"] == "diagnostic_msgs::msg::dds_::DiagnosticArray_"
    assert FORCES in types
    assert CLOUD not in types


async def test_a_plate_that_changes_to_a_skin_changes_its_topics(bridged: Bridged) -> None:
    await bridged.until(lambda _: FORCES in bridged.publications, info=OF_FORCES)
    grid = Grid(origin_m=(0.001, 0.002), pitch_m=0.5e-3)
    traction, std = np.arange(2 * 3 * 30 * 34, dtype="<f4").reshape(2, 3, 30, 34)  # 36.7 kB: many datagrams
    arrays = {"traction_pascal": traction, "traction_std_pascal": std, "displacement_m": None}
    decoded = Decoded(**header(board_ticks=1), **arrays, grid=grid)
    sites = tuple(SiteInfo(site=n, position_m=(n * 1e-3, 0.0)) for n in range(1, 7))
    info = example(Info, rates_hz={"contacts": 100.0, "decoded": 100.0}, sites=sites)
    line = await bridged.until(lambda line: line["what"] == CLOUD, info=info, decoded=decoded)
    points = np.frombuffer(bytes(line["data"]), [(f["name"], {7: "<f4"}[f["datatype"]]) for f in line["fields"]])
    assert (line["width"], line["height"], line["point_step"], line["is_dense"]) == (1020, 1, 36, True)
    np.testing.assert_array_equal(points["traction_z_pascal"], traction[2].ravel())
    np.testing.assert_array_equal(points["traction_std_x_pascal"], std[0].ravel())
    np.testing.assert_allclose(points["x"], np.tile(0.001 + 0.5e-3 * np.arange(34), 30), rtol=1e-6)
    np.testing.assert_allclose(points["y"], np.repeat(0.002 + 0.5e-3 * np.arange(30), 34), rtol=1e-6)
    await bridged.until(lambda _: FORCES not in bridged.publications)
    key = bridged.publications[CLOUD]["key"]
    await bridged.until(lambda _: key in [bytes(gid["data"][:16]).hex() for gid in bridged.nodes[0]["writer_gid_seq"]])
    (node,) = bridged.nodes
    assert (node["node_name"], node["node_namespace"]) == ("resonatord", "/")


async def test_without_a_broker_diagnostics_are_stale_until_it_returns(bridged: Bridged) -> None:
    alive: dict[str, Message] = {"info": OF_FORCES, "state_daemon": ONLINE, "health": example(Health)}
    line = await bridged.until(lambda line: levels(line) == [0, 0], **alive)
    assert line["status"][1]["name"] == "left_index: state/daemon"
    assert line["status"][1]["message"] == "online: all is well"
    assert {"key": "state", "value": "online"} in line["status"][1]["values"]
    await bridged.broker.kill()
    await bridged.until(lambda line: levels(line) == [3, 3])
    await bridged.broker.start()
    await bridged.until(lambda line: levels(line) == [0, 0], **alive)
    await bridged.until(lambda line: line["what"] == WRENCH, contacts=example(Contacts))
    await bridged.until(lambda line: levels(line) == [3, 1], state_daemon=example(State, state="offline"))
