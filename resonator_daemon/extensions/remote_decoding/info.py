"""Decoder settings from the `info` of a plate, or the reason why no decoder is possible."""

import json
import math
from collections.abc import Callable
from typing import Final

import numpy as np

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.skin import Skin
from resonator_daemon.measure.sensors.surface_requests import SurfaceSettings, stated_skin
from resonator_daemon.mqtt.codec import decode
from resonator_daemon.mqtt.payloads import Info
from resonator_daemon.mqtt.topics import DECODED, SCHEMA_VERSION

NO_INFO: Final = Reason(ReasonCode.NO_INFO, "no info yet: no daemon has published under this name")
SITES_MAX: Final = 10_000
INFO_BYTES_MAX: Final = 2_000_000
INT64: Final = range(2**63)  # what subscribers hold numbers in
_REASON_MAX: Final = 200  # characters of an error that become part of a state

MakeSettings = Callable[..., SurfaceSettings]  # of skin, site_ids and pitch_m


class UnusableInfoError(ValueError):
    """Why there is nothing to decode."""

    def __init__(self, text: str, code: ReasonCode = ReasonCode.INFO_UNUSABLE) -> None:
        super().__init__(text)
        self.reason = Reason(code, text)


def read_info(payload: bytes, make_settings: MakeSettings) -> tuple[SurfaceSettings, float]:
    """Read the settings of a decoder and the length of a gate from an `info`."""
    if not payload:
        raise UnusableInfoError(NO_INFO.text, NO_INFO.code)
    try:
        _check_size(payload)
        info = decode(Info, payload)
    except UnusableInfoError:
        raise
    except (ValueError, RecursionError, MemoryError, OverflowError) as error:
        first = (str(error) or repr(error)).splitlines()[0][:_REASON_MAX]
        raise UnusableInfoError(f"info cannot be read: {first}") from error
    if (version := info.schema_version).partition(".")[0] != SCHEMA_VERSION.partition(".")[0]:
        reads = f"this decoder reads {SCHEMA_VERSION}"
        raise UnusableInfoError(f"its messages have schema version {version[:20]!a}, {reads}")
    if DECODED.path in info.rates_hz:
        text = "the daemon decodes this plate itself; set external = true in [decoding] of its configuration"
        raise UnusableInfoError(text, ReasonCode.DECODED_BY_DAEMON)
    if not info.skin:
        raise UnusableInfoError("has no skin to decode; waits for another plate of this name")
    positions_m = np.array([site.position_m for site in info.sites], np.float64).reshape(-1, 2)
    try:
        skin = stated_skin(info.skin, positions_m)
    except ValueError as error:
        raise UnusableInfoError(f"skin in info: {error}") from error
    if problem := _problem(info, skin):
        raise UnusableInfoError(f"info: {problem}")
    site_ids = np.array([site.site for site in info.sites], np.intp)
    settings = make_settings(skin=skin, site_ids=site_ids, pitch_m=info.grid.pitch_m if info.grid else None)
    return settings, 1 / info.frame_rate_hz


def _check_size(payload: bytes) -> None:
    """Refuse what is too long to be checked entry by entry on the event loop."""
    if len(payload) > INFO_BYTES_MAX:
        raise UnusableInfoError(f"info has {len(payload)} bytes, a decoder reads {INFO_BYTES_MAX} at most")
    content = json.loads(payload)
    if not isinstance(content, dict):
        raise ValueError("not a JSON object")
    for key, value in content.items():
        if isinstance(value, list | dict) and len(value) > SITES_MAX:
            what = f"{len(value)} entries in {key[:20]!a}"
            raise UnusableInfoError(f"info has {what}, a decoder takes {SITES_MAX} sites at most")


def _problem(info: Info, skin: Skin) -> str | None:
    """Return why no decoder can be built, None if one can; errors of building itself come later."""
    if not len(skin.site_positions_m):
        return "no sites"
    if not np.isfinite(skin.site_positions_m).all():
        return "sites without a place"
    if not all(site.site in INT64 for site in info.sites):
        return "numbers of sites must be in 0 .. 2^63 - 1"
    if not 1e-9 < info.frame_rate_hz < math.inf:
        return f"frame_rate_hz is {info.frame_rate_hz}, must be above 0"
    if not 0.0 < skin.depth_m < np.inf or not 0.0 <= skin.gain_std < 1.0:
        return f"depth {skin.depth_m} m must be above 0, gain_std {skin.gain_std} in 0 .. 1"
    return None
