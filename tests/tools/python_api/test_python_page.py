"""The examples of docs/how-to/use-from-python.md and the cells of the notebook run as they stand."""

import asyncio
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brokers import Mosquitto, client_of
from commanded import commanded, state
from example_messages import example

from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import Forces, SiteForce
from resonator_daemon.mqtt.topics import STATE_DAEMON
from resonator_daemon.mqtt.verbs import Ping, Pong

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "how-to" / "use-from-python.md"
NOTEBOOK = ROOT / "docs" / "tutorials" / "first-press.ipynb"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder with a recording of presses of 2, 0.5 and 8 N on sites 7, 3 and 16 of an emulated plate."""
    for case, name in (("touches", "run"), ("skin", "skin")):
        shutil.copy(ROOT / "tests" / "corpus" / case / "recording.mcap", tmp_path / f"{name}.mcap")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return tmp_path


async def test_examples_of_the_page_run(mosquitto: Mosquitto, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    examples = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    names: dict[str, Any] = {}

    def run_all() -> None:
        for text in examples:
            scope: dict[str, Any] = {}  # each example stands for itself
            exec(text.replace("mqtt://127.0.0.1:1883", mosquitto.url), scope)
            names.update(scope)

    def pong(_: Ping) -> Pong:
        return Pong(t_ns=1, daemon_boot_id="first", uptime_s=60.25)

    forces = example(Forces, sites=(example(SiteForce, site=3, force_newton=1.75),))
    async with (
        commanded(mosquitto.url, {"ping": pong}, name="left-index") as daemon,
        client_of(mosquitto.url) as client,
    ):
        daemon.publisher.publish(daemon.base, STATE_DAEMON, state("online", "measuring"))
        await client.publish(f"{daemon.base}/forces", encode(forces), retain=True)  # until the example has subscribed
        await asyncio.to_thread(run_all)
    printed = capsys.readouterr().out
    assert re.findall(r"onset at site (\d+)", printed) == ["7", "3", "16"]
    assert "site 3 1.75 N ok" in printed
    assert "\n60.25\nunknown_verb " in printed


def test_the_cells_of_the_notebook_run(folder: Path) -> None:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    names: dict[str, Any] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec("".join(cell["source"]), names)
    assert names["presses"]["contact_site"].tolist() == [7, 3, 16]
    assert names["presses"]["contact_peak_newton"].tolist() == pytest.approx([2.0, 0.5, 8.0], abs=0.2)
    assert abs(names["mean_newton"] - 2.0) < 3 * names["systematic_newton"]
    assert names["axes"].get_ylabel() == "force in N"
    map_pascal, axes = names["image"].get_array(), names["image"].axes
    assert np.unravel_index(map_pascal.argmax(), map_pascal.shape) == (3, 3)  # the press is in the middle of 7 x 7
    assert axes.get_ylim()[0] > axes.get_ylim()[1]
