"""Messages as a plate could publish them, made of the published examples."""

import math
from typing import Any

import numpy as np
import status_samples
from example_messages import NOW_NS, example, header
from numpy.typing import NDArray

from resonator_daemon.mqtt import payloads

S = 1_000_000_000


def state(word: str, reason: str = "", since_s_ago: float = 10.0, **changes: Any) -> payloads.State:
    since_t_ns = NOW_NS - round(since_s_ago * S)
    return payloads.State(**header(**changes), state=word, reason=reason, since_t_ns=since_t_ns)


def info(sites: dict[int, tuple[float, float]], **changes: Any) -> payloads.Info:
    listed = tuple(payloads.SiteInfo(site=site, position_m=position) for site, position in sites.items())
    return example(payloads.Info, **header(**changes), link="tcp://127.0.0.1:5555", sites=listed)


def site_force(site: int, force_newton: float, **changes: Any) -> payloads.SiteForce:
    return example(
        payloads.SiteForce, **{"site": site, "force_newton": force_newton, "systematic_newton": 0.012} | changes
    )


def forces(*sites: payloads.SiteForce, status: str = "ok", **changes: Any) -> payloads.Forces:
    return example(payloads.Forces, **header(**changes), status=status, sites=sites)


def onset(site: int, since_s_ago: float) -> payloads.ContactEvent:
    event = example(payloads.ContactEvent, **header(), event="onset")
    since_t_ns = NOW_NS - round(since_s_ago * S)
    contact = event.contact.model_copy(update={"site": site, "since_t_ns": since_t_ns})
    return event.model_copy(update={"contact": contact})


def contact(
    site: int, normal_newton: float, shear_newton: tuple[float, float] = (math.nan, math.nan), **changes: Any
) -> payloads.Contact:
    force = {"force_newton": (*shear_newton, normal_newton), "noise_newton": (math.nan, math.nan, 0.0006)}
    margin = {"slip_margin": math.nan, "slip_margin_std": math.nan}
    place = {"site": site, "position_m": (0.0, 0.0), "systematic_newton": (math.nan, math.nan, 0.012)}
    return example(payloads.Contact, **{**place, **force, **margin, **changes})


def contacts_of(*found: payloads.Contact) -> payloads.Contacts:
    return example(payloads.Contacts, **header(), contacts=found)


def contacts(site: int, force_newton: float) -> payloads.Contacts:
    return contacts_of(contact(site, force_newton))


def health(**changes: Any) -> payloads.Health:
    figures = {"frame_rate_hz": 1000.04, "clock_drift_ppm": 1.5, "cpu_percent": 21.4, "rss_mb": 92.3}
    return example(payloads.Health, **header(), **{**figures, "recording": status_samples.NOT_RECORDING, **changes})


def decoded(traction_pascal: NDArray[np.float64], std_pascal: float = 100.0) -> payloads.Decoded:
    return payloads.Decoded(
        **header(),
        board_ticks=1,
        traction_pascal=traction_pascal.astype(np.float32),
        traction_std_pascal=np.full(traction_pascal.shape, std_pascal, np.float32),
        displacement_m=None,
        grid=payloads.Grid(origin_m=(-0.0062, -0.0062), pitch_m=4e-4),
    )


def summary(**changes: Any) -> payloads.DecodedSummary:
    return example(payloads.DecodedSummary, **header(), **changes)
