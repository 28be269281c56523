"""Messages that the examples are to print, and a daemon's part in it."""

from typing import Any

import brokers
import numpy as np
from example_messages import example, header

from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import ContactEvent, Decoded, Forces, Grid, Message, SiteForce

HEADER: dict[str, Any] = header(t_ns=1789000000000000123)


def forces(seq: int, *sites: SiteForce) -> Forces:
    return example(Forces, **HEADER | {"seq": seq, "sites": sites})


def force(site: int, force_newton: float, status: str = "ok") -> SiteForce:
    return example(SiteForce, site=site, force_newton=force_newton, status=status)


def event(seq: int, word: str) -> ContactEvent:
    return example(ContactEvent, **HEADER | {"seq": seq, "event": word})


def decoded(seq: int, traction_pascal: np.ndarray, grid: Grid | None) -> Decoded:
    arrays = {"traction_pascal": traction_pascal, "traction_std_pascal": None, "displacement_m": None}
    return Decoded(**HEADER | {"seq": seq}, **arrays, board_ticks=1, grid=grid)


async def publish(broker_url: str, path: str, message: Message, *, plate: str = "left") -> None:
    """Publish a message as a daemon does; retained, so that whoever comes later has it, too."""
    await brokers.publish(broker_url, f"resonator/{plate}/{path}", encode(message), retain=True)
