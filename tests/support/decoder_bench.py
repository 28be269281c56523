"""What the tests of decoder processes share: a small skin, its messages, and a stand-in for its daemon."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiomqtt
import example_messages
import numpy as np
from brokers import client_of
from observer import until as until

from resonator_daemon.base.arrays import Floats
from resonator_daemon.board.config.clients import load_decoder_config
from resonator_daemon.extensions.remote_decoding.service import DecoderProcess
from resonator_daemon.mqtt.codec import Incoming, encode
from resonator_daemon.mqtt.payloads import CalibrationInfo, GridInfo, Info, Lost, Signals, SiteInfo, SkinInfo
from resonator_daemon.mqtt.topics import SCHEMA_VERSION
from simulators.contact import hertz_parts
from simulators.half_space_fields import hertz_fields

E, NU, DEPTH_M, PITCH_M, SIDE = 2e5, 0.5, 1e-3, 4e-4, 12
SITES = SIDE**2
NOISE = np.tile([[2.0**-7], [2.0**-8], [2.0**-8]], SITES)  # powers of two, which rounding keeps
_AXIS_M = (np.arange(SIDE) - (SIDE - 1) / 2) * PITCH_M
SITES_M = np.stack(np.meshgrid(_AXIS_M, _AXIS_M), axis=-1).reshape(-1, 2)
BOOT = "9f3c52d0"
T_NS = 1_789_000_000_000_000_000


def header(seq: int, boot: str = BOOT) -> dict[str, Any]:
    return example_messages.header(
        seq=seq, daemon_boot_id=boot, board_boot_id="51aa03c4", t_ns=T_NS + seq * 10_000_000, lost=Lost(link_gap=3)
    )


def info(**change: Any) -> Info:
    fields: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION, "daemon_version": "0.1.0", "plate": "small", "link": "tcp://127.0.0.1:5000",
        "product": "board", "serial_number": "0042", "firmware": "1.0.0", "counter": "channelised",
        "frame_rate_hz": 100.0, "window_s": 0.01, "step_s": 0.01, "rates_hz": {}, "units": {}, "commands": (),
        "force_max_newton": 5.0, "outline_m": (), "transducers_m": (),
        "sites": tuple(SiteInfo(site=100 + i, position_m=(x, y)) for i, (x, y) in enumerate(SITES_M.tolist())),
        "grid": GridInfo(origin_m=(float(SITES_M[0, 0]), float(SITES_M[0, 1])), pitch_m=PITCH_M, shape=(SIDE, SIDE)),
        "skin": SkinInfo(
            youngs_modulus_pascal=E, poisson_ratio=NU, depth_m=DEPTH_M, gain_std=0.0, correlation_length_m=1e-3,
            tangential_ratio=0.3,
        ),
        "calibration": CalibrationInfo(
            id=None, date=None, unit=None, expiry=None, model_error=0.01, sensitivity_std=0.001, response="off"
        ),
    }  # fmt: skip
    return Info(**header(0), **(fields | change))


def pressed(number: int, normal_newton: float = 1.0) -> Floats:
    """Signals (3, n) of a press with some shear, moving a little with each number, with noise."""
    radii, forces = hertz_parts((0.3, 0.0, normal_newton), 1.2e-3, 0.5)
    fields = hertz_fields(SITES_M - (2e-5 * number, 0.0), DEPTH_M, radii, E, NU)
    clean = np.einsum("kf,kfsn->sn", forces, fields) * np.array([[1.5 / E], [1.0], [1.0]])
    return clean + NOISE * np.random.default_rng(number).standard_normal(clean.shape)


def signals(seq: int, values: Floats | None = None, boot: str = BOOT, **change: Any) -> Signals:
    fields: dict[str, Any] = {
        "board_ticks": 1000 + seq,
        "signals": (pressed(seq % 40) if values is None else values).astype(np.float32),
        "noise_std": NOISE.astype(np.float32),
        "status": "ok",
    }
    return Signals(**(header(seq, boot) | fields | change))


def incoming(topic: str, payload: bytes) -> Incoming:
    return Incoming(topic, payload, False, None, None)


class Daemon:
    """Topics of a daemon that a decoder receives."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self._client = client

    async def send_info(self, plate: str, message: Info) -> None:
        await self._client.publish(f"resonator/{plate}/info", encode(message), qos=1, retain=True)

    async def send(self, plate: str, message: Signals) -> None:
        await self.send_raw(plate, encode(message))

    async def send_raw(self, plate: str, payload: bytes) -> None:
        await self._client.publish(f"resonator/{plate}/signals", payload, qos=0)


@asynccontextmanager
async def daemon(url: str) -> AsyncIterator[Daemon]:
    async with client_of(url) as client:
        yield Daemon(client)


def config_file(folder: Path, url: str, decoding: str = "") -> Path:
    """Write a decoder's configuration: of the plate `hand`, or of those in `decoding`."""
    path = folder / "decoder.toml"
    name = "" if decoding else 'name = "hand"\n'
    path.write_text(f'{name}[mqtt]\nurl = "{url}"\n[decoding]\ncontact_physics = false\n{decoding}')
    return path


def process(folder: Path, url: str, decoder_id: str = "host-1", *, decoding: str = "") -> DecoderProcess:
    return DecoderProcess(load_decoder_config(config_file(folder, url, decoding)), decoder_id)


@asynccontextmanager
async def running(decoder: DecoderProcess) -> AsyncIterator[DecoderProcess]:
    task = asyncio.create_task(decoder.run())
    try:
        yield decoder
    finally:
        decoder.stop()
        await task


def assert_exact(decoder: DecoderProcess) -> None:
    for plate in decoder.health().plates.values():
        assert plate.received == plate.decoded + plate.skipped + plate.unusable + plate.waiting
