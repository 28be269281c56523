"""Tones of the corners to payloads: what `tones` publishes, and the ladder of codes that `info` has."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.forces.readings import CornerTone as MeasuredTone
from resonator_daemon.estimate.forces.readings import ForceReading
from resonator_daemon.measure.sensors.plate_sites import force_sites
from resonator_daemon.mqtt.codec import Encoded, encode_fields
from resonator_daemon.mqtt.payload_types import rounded, rounded_std
from resonator_daemon.mqtt.payloads import CapturedTone, SiteCode, Tones

_CODE_PLACES: Final = 3
_RESIDUAL_PLACES: Final = 2


def site_codes(plate: Plate) -> tuple[SiteCode, ...]:
    """Return the codes of a plate's force sites in the order of the sites."""
    sites = force_sites(plate)
    loaded_hz = np.round(sites.f0_hz / (1.0 - sites.sensitivity * plate.force_max_newton), _CODE_PLACES)
    return tuple(
        SiteCode(site=site, f0_hz=tuple(f0_hz), full_load_hz=tuple(full_load_hz))
        for site, f0_hz, full_load_hz in zip(
            plate.site_ids.tolist(), sites.f0_hz.tolist(), loaded_hz.tolist(), strict=True
        )
    )


def tones_message(plate: Plate, seq: int, header: dict[str, Any], reading: ForceReading) -> Encoded:
    """Return the message about a reading that has tones; `header` is that of its other messages."""
    site_ids = plate.site_ids
    fields = {
        "name": header["name"],
        "seq": seq,
        **header,
        "window_s": reading.window_s,
        "corners": tuple([_corner(tone, site_ids) for tone in reading.tones or ()]),
    }
    return encode_fields(Tones, fields)


def _corner(tone: MeasuredTone, site_ids: NDArray[np.int64]) -> dict[str, Any]:
    fields = {
        "captured": CapturedTone(tone.captured),
        "site": None if tone.site is None else int(site_ids[tone.site]),
        "frequency_hz": rounded(tone.frequency_hz, tone.noise_hz),
        "noise_hz": rounded_std(tone.noise_hz),
        "residual": round(tone.residual, _RESIDUAL_PLACES),
    }
    return fields if tone.reason_code is None else {**fields, "reason_code": tone.reason_code}
