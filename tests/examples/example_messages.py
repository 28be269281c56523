"""Messages that the examples are to print, and a daemon's part in it."""

import math
from typing import Any

import aiomqtt
import numpy as np

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.payloads import Compensation, Decoded, Forces, Grid, Lost, Message, SiteForce

HEADER: dict[str, Any] = {
    "daemon_boot_id": "9f3c",
    "board_boot_id": "51aa",
    "t_ns": 1789000000000000123,
    "t_unc_ns": 42000,
    "lost": Lost(),
    "board_ticks": 1,
}


def forces(seq: int, *sites: SiteForce) -> Forces:
    compensation = Compensation(
        baseline="followed",
        common_mode=(0.0,) * 4,
        common_mode_std=2e-7,
        plate_kelvin=math.nan,
        plate_kelvin_std=math.nan,
        response="off",
    )
    told: dict[str, Any] = {"status": "ok", "reason": "", "beats": (), "compensation": compensation}
    return Forces(**HEADER, seq=seq, window_s=0.01, sites=sites, **told)


def force(site: int, force_newton: float, status: str = "ok") -> SiteForce:
    errors = {"noise_newton": 6e-4, "systematic_newton": 0.012}
    return SiteForce(site=site, force_newton=force_newton, status=status, **errors)


def decoded(seq: int, traction_pascal: np.ndarray, grid: Grid | None) -> Decoded:
    arrays = {"traction_pascal": traction_pascal, "traction_std_pascal": None, "displacement_m": None}
    return Decoded(**HEADER, seq=seq, **arrays, grid=grid)


async def publish(broker_url: str, path: str, message: Message, *, plate: str = "left") -> None:
    """Publish a message as a daemon does; retained, so that whoever comes later has it, too."""
    at = Mqtt(url=broker_url)
    async with aiomqtt.Client(at.host, at.port) as client:
        await client.publish(f"{at.prefix}/{plate}/{path}", encode(message), qos=1, retain=True)
