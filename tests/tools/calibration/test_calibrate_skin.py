"""`resonatord calibrate skin` as a user meets it: with a plate that publishes, without load, without broker or skin."""

import asyncio
import json
import tomllib
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from brokers import Mosquitto, free_port
from command_line import exit_code
from plates import plate_head, skin_grid, skin_table

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.codec import Outgoing
from resonator_daemon.mqtt.payloads import Lost, Signals
from resonator_daemon.mqtt.publisher import Publisher
from resonator_daemon.mqtt.topics import SIGNALS
from simulators.half_space_fields import hertz_fields

Printed = tuple[int | None, str, str]  # exit code, stdout and stderr
Calibrate = Callable[..., Awaitable[Printed]]

HEADER = {
    "name": "left-index", "daemon_boot_id": "9f3c", "board_boot_id": "51aa", "t_uncertainty_ns": 42_000,
    "lost": Lost(), "board_ticks": None
}  # fmt: skip
FRAME_NS = 250_000_000
NOISE = 2e-4
PLATE = plate_head("small", (-2, -2), (2, 2), 5, "channelised") + skin_table() + skin_grid(7, 0.5, 3250, (3, 21, 1))


def write_config(directory: Path, url: str, plate: str = "small.toml", name: str = 'name = "left"') -> str:
    (directory / "small.toml").write_text(PLATE)
    path = directory / "board.toml"
    path.write_text(f'{name}\nplate = "{plate}"\nlink = "tcp://127.0.0.1:9"\n[mqtt]\nurl = "{url}"\n')
    return str(path)


@pytest.fixture
def calibrate(capsys: pytest.CaptureFixture[str]) -> Calibrate:
    """`calibrate skin` in a thread of this process."""

    async def run(*arguments: str) -> Printed:
        code = await asyncio.to_thread(exit_code, "calibrate", "skin", *arguments)
        return code, *capsys.readouterr()

    return run


def pressed(frame: int, directory: Path) -> Floats:
    """A sheared press that wanders, every other frame; noise in all."""
    rng = np.random.default_rng(frame)
    noise = NOISE * rng.standard_normal((3, 49))
    if frame % 2:
        return noise
    sites_m = load_plate(str(directory / "small.toml")).site_positions_m
    fields = hertz_fields(sites_m - rng.uniform(-1e-3, 1e-3, 2), 1e-3, [1e-3], 2e5, 0.5)[0]
    force = np.array([*rng.uniform(-0.2, 0.2, 2), 0.5])
    return np.asarray(np.einsum("f,fsn->sn", force, fields) * np.array([[1.5 / 2e5], [1.0], [1.0]]) + noise)


@asynccontextmanager
async def plate(url: str, frames: list[Floats], name: str = "left", noise: float = NOISE) -> AsyncIterator[None]:
    """A plate that publishes these frames again and again, a quarter of a second apart by their own time."""
    will = Outgoing(f"resonator/{name}/state/daemon", b"{}")
    publisher = Publisher(Mqtt(url=url), identifier=name, make_will=lambda: will)

    async def publish() -> None:
        for seq in range(100_000):
            signals = frames[seq % len(frames)].reshape(3, 7, -1).astype(np.float32)
            noise_std = np.full_like(signals, noise)
            at_ns = seq * FRAME_NS
            message = Signals(seq=seq, t_ns=at_ns, signals=signals, noise_std=noise_std, status="ok", **HEADER)
            publisher.publish(f"resonator/{name}", SIGNALS, message)
            await asyncio.sleep(0.01)

    tasks = [asyncio.create_task(publisher.run()), asyncio.create_task(publish())]
    yield
    tasks[1].cancel()
    await publisher.close()
    await asyncio.wait(tasks)


async def test_lines_to_paste(mosquitto: Mosquitto, tmp_path: Path, calibrate: Calibrate) -> None:
    config = write_config(tmp_path, mosquitto.url)
    async with plate(mosquitto.url, [pressed(frame, tmp_path) for frame in range(20)]):
        code, printed, reported = await calibrate("--config", config, "--seconds", "0.4")
    assert code == 0, reported
    assert "Traceback" not in reported
    (tmp_path / "small.toml").write_text(PLATE.replace("[grid]", printed + "[grid]"))  # as the user would
    found, skin = tomllib.loads(printed), load_plate(str(tmp_path / "small.toml")).skin
    assert skin is not None
    assert skin.correlation_length_m == pytest.approx(1e-3 * found["correlation_length_mm"])
    assert 0.2 < skin.correlation_length_mm < 5.0
    assert 0.02 < skin.tangential_ratio < 2.0


async def test_json_is_one_object(mosquitto: Mosquitto, tmp_path: Path, calibrate: Calibrate) -> None:
    config = write_config(tmp_path, mosquitto.url, name="")  # the topics then bear the board's serial number
    async with plate(mosquitto.url, [pressed(frame, tmp_path) for frame in range(20)]):
        code, printed, _ = await calibrate("--config", config, "--seconds", "0.4", "--json")
    assert code == 0
    assert printed.count("\n") == 1
    found = json.loads(printed, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert found["plate"] == "left"
    assert abs(found["frames"] - 2 * found["frames_with_load"]) <= 1
    fit = found["fit"]
    assert fit["frames_used"] == found["frames_with_load"]
    assert 0.2e-3 < fit["correlation_length_m"] < 5e-3
    assert fit["log_evidence_gain"] >= 0.0


async def test_another_plate_than_the_file_states(mosquitto: Mosquitto, tmp_path: Path, calibrate: Calibrate) -> None:
    config = write_config(tmp_path, mosquitto.url)
    async with plate(mosquitto.url, [np.zeros((3, 42))]):
        code, printed, reported = await calibrate("--config", config)
    assert (code, printed) == (78, "")
    assert "plate 'left' publishes 42 sites, the plate file has 49" in reported


async def test_what_cannot_work_is_reported_at_once(tmp_path: Path, calibrate: Calibrate) -> None:
    port = free_port()
    code, printed, reported = await calibrate("--config", write_config(tmp_path, f"mqtt://127.0.0.1:{port}"))
    assert (code, printed) == (69, "")
    assert f"no broker at 127.0.0.1:{port} (" in reported
    assert reported.count("\n") == 1
    code, _, reported = await calibrate("--config", write_config(tmp_path, "mqtt://127.0.0.1:9", "quartz16"))
    assert code == 78
    assert "'quartz16' has no [skin]" in reported
    code, _, reported = await calibrate("--config", str(tmp_path / "none.toml"))
    assert code == 78
    assert "Traceback" not in reported
    assert (await calibrate())[0] == 2
