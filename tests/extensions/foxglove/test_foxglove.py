"""The bridge to Foxglove, read by a plain WebSocket client and judged by the schemas of Foxglove's SDK."""

import asyncio
import json
import re
import signal
import struct
import sys
from asyncio.subprocess import PIPE
from collections import defaultdict
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any

import foxglove.messages
import numpy as np
import pytest
from brokers import publish
from example_messages import NOW_NS, example, header
from export_bench import played, points
from jsonschema import Draft202012Validator
from observer import until
from scipy.spatial.transform import Rotation
from websockets.asyncio.client import ClientConnection, connect

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.board.config.tables import Listen
from resonator_daemon.commands import main
from resonator_daemon.extensions.foxglove.messages import FoxgloveMessages
from resonator_daemon.extensions.foxglove.server import BACKLOG_MAX, FoxgloveServer
from resonator_daemon.extensions.viewer_support import Geometry
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import Contact, Contacts, Decoded, Forces, Grid, Info, Message, State
from resonator_daemon.mqtt.topics import TOPICS

LAYOUT = Path(__file__).parents[3] / "docs" / "examples" / "foxglove" / "resonatord.json"
HEADER = struct.Struct("<BIQ")  # of message data: opcode 1, subscription, log time
INFO = example(Info, **header())
MAP = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
PLACED = {"id": 4, "position_m": (0.002, -0.001), "force_newton": (0.0, -1.5, 2.0), "moment_newton_m": (1.0, 2.0, 3.0)}
PRESS = example(Contacts, contacts=(example(Contact, **PLACED),))


class Viewer:
    """What a viewer was sent: schemas and messages by channel."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.schemas: dict[str, Draft202012Validator] = {}
        self.names: dict[int, str] = {}
        self.found: dict[str, list[Any]] = defaultdict(list)

    async def until(self, channel: str, count: int = 1) -> Any:
        """Subscribe to what is advertised, and read until a channel has so many messages; return the last."""
        async with asyncio.timeout(20):
            while len(self.found[channel]) < count:
                await self.receive()
        return self.found[channel][-1]

    async def receive(self) -> None:
        frame = await self.socket.recv()
        if isinstance(frame, bytes):
            opcode, number, _ = HEADER.unpack_from(frame)
            assert opcode == 1
            payload = json.loads(frame[HEADER.size :])
            self.schemas[self.names[number]].validate(payload)
            self.found[self.names[number]].append(payload)
        elif (message := json.loads(frame))["op"] == "advertise":
            for one in message["channels"]:
                assert (one["encoding"], one["schemaEncoding"]) == ("json", "jsonschema")
                self.names[one["id"]] = one["topic"]
                self.schemas[one["topic"]] = Draft202012Validator(json.loads(one["schema"]))
            await self.subscribe(one["id"] for one in message["channels"])
        elif message["op"] == "status":  # unknown: the SDK advertises a channel before it takes subscriptions
            await self.subscribe([int(message["message"].rpartition(" ")[2])])

    async def subscribe(self, numbers: Iterable[int]) -> None:
        wanted = [{"id": number, "channelId": number} for number in numbers]
        await self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    async def send(self, server: FoxgloveServer, path: str, message: Message) -> None:
        """Add a message of the plate "left" as soon as this viewer has subscribed to its channels."""
        await self.until("left/info")
        await until(lambda: server.wants("left", path))
        server.add("left", path, message)


@asynccontextmanager
async def viewer(port: int) -> AsyncIterator[Viewer]:
    async with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:  # type: ignore[list-item]
        yield Viewer(socket)


@pytest.fixture
async def server() -> AsyncIterator[FoxgloveServer]:
    serving = FoxgloveServer(Listen("127.0.0.1", 0), prefixed=True)
    serving.start()
    yield serving
    serving.close()


def state(word: str) -> State:
    return State(**header(), state=word, reason="", since_t_ns=NOW_NS)


def decoded(traction: Any = MAP) -> Decoded:
    grid = Grid(origin_m=(-0.01, 0.02), pitch_m=5e-4)
    arrays = {"traction_pascal": traction, "traction_std_pascal": None, "displacement_m": 2 * traction}
    return Decoded(**header(), board_ticks=1, grid=grid, **arrays)


async def test_a_viewer_that_comes_late_sees_plate_states_contacts_and_map(server: FoxgloveServer) -> None:
    server.add("left", "contacts", example(Contacts, contacts=()))  # before it is known where anything is
    for path, message in (("state/link", state("online")), ("info", INFO), ("decoded", decoded()), ("contacts", PRESS)):
        server.add("left", path, message)
    assert not server.wants("left", "decoded")  # no viewer has it
    async with viewer(server.port) as seen:
        assert (await seen.until("left/state/link"))["state"] == "online"
        (turn,) = (await seen.until("left/transforms"))["transforms"]
        assert (turn["child_frame_id"], turn["rotation"]) == ("left", {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0})
        outline = (await seen.until("left/plate/scene"))["entities"][0]["lines"][0]["points"]
        assert [(corner["x"], corner["y"]) for corner in outline] == list(INFO.outline_m)
        assert points(await seen.until("left/sites/cloud"))["site"].tolist() == [site.site for site in INFO.sites]
        await seen.send(server, "decoded", decoded())
        await seen.send(server, "contacts", PRESS)
        grid = await seen.until("left/decoded/grid")
        cells = points(grid).reshape(-1, grid["column_count"])
        np.testing.assert_array_equal(cells["traction_z_pascal"], MAP[2])
        np.testing.assert_allclose([grid["pose"]["position"][axis] for axis in "xy"], [-0.01025, 0.01975])
        (wrench,) = (await seen.until("left/contacts/wrenches"))["wrenches"]
        assert (wrench["id"], wrench["force"]) == (4, {"x": 0.0, "y": -1.5, "z": 2.0})
        assert wrench["torque"] == {"x": 1.0, "y": 2.0, "z": 3.0}
        (drawn,) = (await seen.until("left/contacts/scene"))["entities"]
        ((arrow,), (text,)) = drawn["arrows"], drawn["texts"]
        along = Rotation.from_quat([arrow["pose"]["orientation"][axis] for axis in "xyzw"]).apply([1.0, 0.0, 0.0])
        np.testing.assert_allclose(along, [0.0, -0.6, 0.8], atol=1e-12)  # as its force
        tail = np.array([arrow["pose"]["position"][axis] for axis in "xyz"])
        tip = tail + along * (arrow["shaft_length"] + arrow["head_length"])
        np.testing.assert_allclose(tip, [0.002, -0.001, 0.0], atol=1e-12)
        assert text["text"].startswith("2.50 N")
        assert drawn["frame_id"] == grid["frame_id"] == "left"


async def test_drawings_end_with_the_measurement_and_plates_change(server: FoxgloveServer) -> None:
    for topic, message in (("info", INFO), ("contacts", PRESS), ("decoded", decoded())):
        server.add("left", topic, message)
    async with viewer(server.port) as seen:
        await seen.send(server, "contacts", PRESS)
        await seen.send(server, "decoded", decoded())
        server.add("left", "state/daemon", state("offline"))
        assert (await seen.until("left/contacts/scene", 2))["entities"][0]["arrows"] == []
        assert np.isnan(points(await seen.until("left/decoded/grid", 2))["traction_x_pascal"]).all()
        server.add("left", "info", example(Info, **header(), sites=({"site": 99, "position_m": (0.001, 0.002)},)))
        assert points(await seen.until("left/sites/cloud", 2))["site"].tolist() == [99]
        server.add("left", "forces", example(Forces))  # of the plate before: not drawn
        server.add("right", "state/link", state("waiting"))
        assert (await seen.until("right/state/link"))["state"] == "waiting"
        assert "left/forces" in seen.schemas
        assert "left/forces/cloud" not in seen.schemas
        assert len(seen.found["left/contacts"]) == 1  # nothing is invented there


async def test_a_viewer_that_stalls_loses_the_oldest(server: FoxgloveServer) -> None:
    large = decoded(np.zeros((3, 90, 90), np.float32))
    server.add("left", "info", INFO)
    server.add("left", "decoded", large)
    async with viewer(server.port) as seen:
        await seen.send(server, "decoded", large)
        for number in range(3 * BACKLOG_MAX):
            server.add("left", "decoded", large.model_copy(update={"t_ns": number}))
        grids = seen.found["left/decoded/grid"]
        while not grids or grids[-1]["timestamp"]["nsec"] != 3 * BACKLOG_MAX - 1:
            await seen.until("left/decoded/grid", len(grids) + 1)
        assert len(grids) < 2 * BACKLOG_MAX


def test_messages_have_the_fields_of_the_sdk_and_files_the_channels_of_the_layout() -> None:
    """Names of fields stand in the descriptors that the SDK serves: `name` is the first field of each, a text."""
    kinds, channels = set(), set()
    for case in ("skin", "slide"):
        messages = FoxgloveMessages("left", Geometry.of_plate(played(case).config.plate))
        of_topics = [(path, message) for path in TOPICS for message in played(case).messages(path)]
        for one in chain(messages.of_plate(0), *(messages.of_message(*each, 0) for each in of_topics)):
            channels.add(one.channel)
            if one.schema["title"].startswith("foxglove."):
                kinds.add(kind := one.schema["title"].removeprefix("foxglove."))
                descriptors = getattr(foxglove.messages, kind).get_schema().data
                for key in {*re.findall(rb'"(\w+)": ', one.encode())} - {b"sec", b"nsec"}:  # protobuf has its own time
                    assert b"\n%c%s" % (len(key), key) in descriptors
    assert kinds == {"PointCloud", "Grid", "SceneUpdate", "FrameTransforms", "Log"}
    panels = json.loads(LAYOUT.read_text())["configById"].values()
    shown = {name for panel in panels for name in panel.get("topics", ())}
    paths = {path["value"].partition(".")[0] for panel in panels for path in panel.get("paths", ())}
    assert shown | paths <= channels | {"state/daemon"}


@asynccontextmanager
async def ending(process: asyncio.subprocess.Process) -> AsyncIterator[None]:
    try:
        yield
    finally:
        with suppress(ProcessLookupError):
            process.kill()


async def test_the_command_survives_its_broker_and_ends_at_once(mosquitto: Any) -> None:
    options = ("--url", mosquitto.url, "--listen", "127.0.0.1:0", "--plate", "left", "--json")
    command = (sys.executable, "-m", "resonator_daemon.commands", "bridge", "foxglove", *options)
    process = await asyncio.create_subprocess_exec(*command, stdout=PIPE, stderr=PIPE)
    assert process.stderr is not None
    assert process.stdout is not None
    async with asyncio.timeout(30), ending(process):
        url = json.loads(await process.stdout.readline())["url"]
        while b"connected" not in await process.stderr.readline():
            pass
        async with viewer(int(url.removeprefix("ws://127.0.0.1:"))) as seen:
            for count, word in enumerate(("online", "lost"), 1):
                await publish(mosquitto.url, "resonator/left/state/link", encode(state(word)), retain=True)
                assert (await seen.until("state/link", count))["state"] == word
                await mosquitto.kill()
                await mosquitto.start()
            await publish(mosquitto.url, "resonator/left/info", encode(INFO), retain=True)
            await seen.until("plate/scene")
        process.send_signal(signal.SIGTERM)
        assert await process.wait() == 0


def test_an_address_that_other_computers_reach_is_refused_as_there_is_no_password() -> None:
    assert main(["bridge", "foxglove", "--listen", "0.0.0.0:8765"]) == ExitCode.USAGE
