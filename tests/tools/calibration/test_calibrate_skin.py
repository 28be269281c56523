"""`resonatord calibrate skin` as a user meets it: with a plate that publishes, without broker or skin."""

import asyncio
import json
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
FRAME_NS = 20_000_000
NOISE = 2e-3
SITES_M = 4e-4 * (np.stack(np.meshgrid(np.arange(12), np.arange(12)), axis=-1).reshape(-1, 2) - 5.5)
PLATE = (
    plate_head("small", (-2.4, -2.4), (2.4, 2.4), 5, "channelised")
    + skin_table()
    + skin_grid(12, 0.4, 3250, (3, 36, 1))
)


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


def press(centre_m: tuple[float, float]) -> Floats:
    """Signals of a ball of 1 mm under 0.5 N on a skin that is deeper, softer and more sensitive than in its file."""
    depth_m, modulus_pascal, gain = 1.05e-3, 0.95 * 2e5, 1.05
    radius_m = np.cbrt(0.75 * 0.5 * 1e-3 * 0.75 / modulus_pascal)
    fields = hertz_fields(SITES_M - centre_m, depth_m, [radius_m], modulus_pascal, 0.5)[0]
    return np.asarray(gain * 0.5 * fields[2] * np.array([[1.5 / 2e5], [1.0], [1.0]]))


def frames(*presses: Floats) -> list[Floats]:
    """Some frames at rest and 40 of each press, with noise."""
    rng = np.random.default_rng(3)
    return [
        signals + NOISE * rng.standard_normal(signals.shape)
        for pressed in presses
        for signals in 8 * [np.zeros_like(pressed)] + 40 * [pressed]
    ]


@asynccontextmanager
async def plate(url: str, frames: list[Floats], name: str = "left", noise: float = NOISE) -> AsyncIterator[None]:
    """A plate that publishes these frames again and again, 20 ms apart by their own time."""
    will = Outgoing(f"resonator/{name}/state/daemon", b"{}")
    publisher = Publisher(Mqtt(url=url), identifier=name, make_will=lambda: will)

    async def publish() -> None:
        for seq in range(100_000):
            signals = frames[seq % len(frames)].reshape(3, 12, -1).astype(np.float32)
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


PLACES_M = ((0.0, 0.0), (6e-4, -3e-4), (-5e-4, 5e-4))
BALL = ("--ball", "1", "--timeout-s", "20", "--load-newton", "0.5", "--presses", "3", "--accept")


async def test_depth_modulus_and_gain_are_written(mosquitto: Mosquitto, tmp_path: Path, calibrate: Calibrate) -> None:
    config, written = write_config(tmp_path, mosquitto.url), tmp_path / "new.toml"
    outside, crooked = press((2.0e-3, 0.0)), press((0.0, 0.0)) + press((9e-4, 0.0))
    first, second, third = map(press, PLACES_M)
    presses = [first, outside, second, crooked, third]
    async with plate(mosquitto.url, frames(*presses)):
        code, printed, reported = await calibrate(config, *BALL, "--output", str(written), "--json")
    assert code == 0, reported
    events = [json.loads(line) for line in printed.splitlines()]
    judged = [event["event"] for event in events if event.get("event") in ("accepted", "rejected")]
    assert (judged.count("accepted"), "rejected" in judged) == (3, True)
    before, after = load_plate(str(tmp_path / "small.toml")), load_plate(str(written))
    assert after.calibration.id is not None
    assert after.skin.depth_mm == pytest.approx(1.05, abs=3 * after.skin.depth_std_mm)
    assert after.skin.youngs_modulus_pascal == pytest.approx(1.9e5, abs=3 * after.skin.modulus_std_pascal)
    assert 0.0 < after.skin.depth_std_mm < 0.01
    assert 0.0 < after.skin.modulus_std_pascal < 2e3
    np.testing.assert_allclose(after.tones.sensitivity / before.tones.sensitivity, 1.05, rtol=5e-3)


async def test_a_ball_of_another_radius_is_refused(mosquitto: Mosquitto, tmp_path: Path, calibrate: Calibrate) -> None:
    config, written = write_config(tmp_path, mosquitto.url), tmp_path / "new.toml"
    async with plate(mosquitto.url, frames(*map(press, PLACES_M))):
        code, printed, _ = await calibrate(config, "--ball", "1.5", *BALL[2:], "--output", str(written), "--json")
    result = json.loads(printed.splitlines()[-1])
    assert (code, result["error"]["code"], written.exists()) == (1, "not_calibrated", False)
    assert result["ball_radius_m"] == pytest.approx(1e-3, rel=0.02)


async def test_another_plate_than_the_file_states(mosquitto: Mosquitto, tmp_path: Path, calibrate: Calibrate) -> None:
    config = write_config(tmp_path, mosquitto.url)
    async with plate(mosquitto.url, [np.zeros((3, 12 * 13))]):
        code, printed, reported = await calibrate("--config", config, *BALL)
    assert (code, printed) == (78, "")
    assert "plate 'left' publishes 156 sites, the plate file has 144" in reported


async def test_what_cannot_work_is_reported_at_once(tmp_path: Path, calibrate: Calibrate) -> None:
    port = free_port()
    code, printed, reported = await calibrate("--config", write_config(tmp_path, f"mqtt://127.0.0.1:{port}"), *BALL)
    assert (code, printed) == (69, "")
    assert f"no broker at 127.0.0.1:{port} (" in reported
    assert reported.count("\n") == 1
    code, _, reported = await calibrate("--config", write_config(tmp_path, "mqtt://127.0.0.1:9", "quartz16"), *BALL)
    assert code == 78
    assert "'quartz16' has no [skin]" in reported
    code, _, reported = await calibrate("--config", str(tmp_path / "none.toml"), *BALL)
    assert code == 78
    assert "Traceback" not in reported
    assert (await calibrate())[0] == 2
