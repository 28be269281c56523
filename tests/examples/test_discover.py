"""docs/examples/python/discover.py finds every plate on a broker and draws it from `info` alone."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from example_programs import finished
from published import HEADER, publish
from report_makers import Messages, configured

from firmware_protocol.messages import Configuration, Description, Identity
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.session.frames import BoardOnline
from resonator_daemon.mqtt.payloads import Info, State

SHIPPED = ("quartz16", "skin32", "fingertip400")
CIRCLE = "{http://www.w3.org/2000/svg}circle"


def info(tmp_path: Path, plate: str) -> Info:
    """What a daemon with this plate publishes."""
    identity = Identity("RD board <1>", "0042", "1.2.0", 0)
    board = BoardOnline(identity, Description(1, 4, 1, 10**9, 1, 9, plate), 7, Configuration(10**6), continues=False)
    return Messages(configured(tmp_path, plate)).states.info(board, 1)


async def discover(broker_url: str, folder: Path) -> str:
    code, said, _ = await finished("discover", broker_url, Mqtt(url=broker_url).prefix, folder)
    assert code == 0
    return said


def drawn(picture: Path, kind: str) -> tuple[list[str | None], np.ndarray]:
    """Return what the circles of a kind are called, and where they are on the plate, in m."""
    circles = [each for each in ElementTree.parse(picture).iter(CIRCLE) if each.get("class") == kind]
    places = np.array([(float(each.get("cx", "nan")), float(each.get("cy", "nan"))) for each in circles])
    return [each.findtext("{http://www.w3.org/2000/svg}title") for each in circles], places / 1e3


def assert_drawn_in_place(plate: Plate, picture: Path) -> None:
    names, places_m = drawn(picture, "site")
    assert names == [str(site) for site in plate.site_ids]
    np.testing.assert_allclose(places_m, plate.site_positions_m, atol=1e-8)
    np.testing.assert_allclose(drawn(picture, "transducer")[1], plate.transducers_m, atol=1e-8)
    (outline,) = ElementTree.parse(picture).iter("{http://www.w3.org/2000/svg}polygon")
    corners = [[float(number) for number in corner.split(",")] for corner in outline.get("points", "").split()]
    np.testing.assert_allclose(np.array(corners) / 1e3, plate.outline_m, atol=1e-8)


async def test_every_plate_is_drawn_from_its_info(broker, tmp_path: Path) -> None:
    for plate in SHIPPED:
        await publish(broker.url, "info", info(tmp_path, plate), plate=f"my {plate}")
    said = await discover(broker.url, tmp_path)
    for plate in SHIPPED:
        assert f"my {plate}: unknown, {plate}, {len(load_plate(plate).site_ids)} sites" in said
        assert_drawn_in_place(load_plate(plate), tmp_path / f"my%20{plate}.svg")


@pytest.mark.parametrize("name", ["left", "..", '"><script>'])
async def test_a_plate_says_how_it_is_and_what_it_is(mosquitto, tmp_path: Path, name: str) -> None:
    online = State(**HEADER, state="online", reason="", since_t_ns=1)
    await publish(mosquitto.url, "info", info(tmp_path, "quartz16"), plate=name)
    await publish(mosquitto.url, "state/daemon", online, plate=name)
    folder = tmp_path / "pictures"
    folder.mkdir()
    said = await discover(mosquitto.url, folder)
    assert said.startswith(f"{name}: online, quartz16, 16 sites up to 10 N, single-tone\n")
    assert "board 0042, RD board <1> 1.2.0, 1000 frames/s\n" in said
    assert "calibration not named, no expiry date\n" in said
    assert "publishes forces 200/s" in said
    (picture,) = folder.iterdir()
    words = "".join(ElementTree.parse(picture).getroot().itertext())
    assert f"{name}: online" in words
    assert "RD board <1>" in words


async def test_a_daemon_that_never_met_its_board_is_listed(mosquitto, tmp_path: Path) -> None:
    state = State(**HEADER, state="online", reason="", since_t_ns=1)
    await publish(mosquitto.url, "state/daemon", state, plate="right")
    assert await discover(mosquitto.url, tmp_path) == "right: online, has published no info\n"
