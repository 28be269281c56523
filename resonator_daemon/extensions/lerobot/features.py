"""Features of a dataset, and their values in the messages of a reading."""

import math
from typing import Any, Final

from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config import Config
from resonator_daemon.board.recording.reader import plate_fingerprints
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.mqtt.payload_types import UNITS, Status
from resonator_daemon.mqtt.payloads import Contacts, Decoded, Forces, Message, Signals
from resonator_daemon.mqtt.topics import CONTACTS, DECODED, FORCES, SIGNALS

Values = dict[str, Any]  # by key; what can be assigned to an array of the feature's shape

PREFIX: Final = "observation.tactile."
PROVENANCE_KEY: Final = "resonatord"  # of info.json
COMPARED: Final = ("plate_sha256", "wire_sha256", "calibration_id")  # of what it states
_INDICES: Final = ("frame_index", "episode_index", "index", "task_index")
_TIMES: Final = {"t_ns": "int64", "timestamp": "float32"}
SINGLES: Final = {f"{PREFIX}valid": "bool", **_TIMES, **dict.fromkeys(_INDICES, "int64")}
"""Data types of the features that all datasets have; each is one value."""


def describe(config: Config, topics: tuple[str, ...]) -> dict[str, Any]:
    """Return what info.json states of the recordings of a plate with these settings.

    The first feature decides which frames are valid: the force, else the traction, else the signals.
    """
    plate, sensor = config.plate, sensor_of(config.plate, config.measurement, config.decoding)
    sites, axes = [f"site_{site}" for site in plate.site_ids], [*"xyz"] if plate.skin else ["z"]
    pixels, names = ([*plate.grid.shape], ["y", "x"]) if plate.grid else ([len(sites)], ["site"])
    tactile = (
        (FORCES, "force", [len(sites)], sites, "N"),
        (DECODED, "traction", [3, *pixels], ["axis", *names], "Pa"),
        (SIGNALS, "signals", [3, len(sites)], ["signal", "site"], "1"),
        (CONTACTS, "contact.force", [len(axes)], axes, "N"),
        (CONTACTS, "contact.position", [2], ["x", "y"], "m"),
        *([(CONTACTS, "contact.slip_margin", [1], ["slip_margin"], "1")] if plate.skin else []),
    )
    features: dict[str, Any] = {
        f"{PREFIX}{key}": {"dtype": "float32", "shape": shape, "names": names, "unit": unit}
        for topic, key, shape, names, unit in tactile
        if topic in sensor.streams and topic.path in topics
    }
    features |= {key: {"dtype": kind, "shape": [1], "names": None} for key, kind in SINGLES.items()}
    ours = plate_fingerprints(plate) | {"calibration_id": plate.calibration.id, "units": UNITS}
    return {"robot_type": plate.name, "fps": frames_a_second(sensor.step_s), "features": features, PROVENANCE_KEY: ours}


def frames_a_second(step_s: float) -> float:
    """Return the rate of readings; an int, as LeRobot has it, if it is whole."""
    rate = round(1 / step_s, 9)
    return int(rate) if rate.is_integer() else rate


def values_of(message: Message, plate: Plate) -> Values:
    """Return the known values in a message.

    A site that `forces` does not list has no force if the status is `ok`; otherwise its force is unknown. The same
    holds for `contacts` without a contact. Of several contacts, the one with the largest normal force counts; if any
    normal force is unknown, none does.
    """
    at_rest = 0.0 if getattr(message, "status", None) == Status.OK else math.nan
    values: Values = {}
    match message:
        case Forces():
            known = {force.site: force.force_newton for force in message.sites}
            values = {"force": [known.get(site, at_rest) for site in plate.site_ids.tolist()]}
        case Signals():
            values = {"signals": message.signals}
        case Decoded():
            values = {"traction": message.traction_pascal}
        case Contacts(contacts=()):
            values = {"contact.force": at_rest}
        case Contacts() if not any(math.isnan(contact.force_newton[2]) for contact in message.contacts):
            largest = max(message.contacts, key=lambda contact: contact.force_newton[2])
            force = largest.force_newton if plate.skin else largest.force_newton[2:]
            slip = math.nan if largest.slip_margin is None else largest.slip_margin
            values = {"contact.force": force, "contact.position": largest.position_m, "contact.slip_margin": slip}
    return {f"{PREFIX}{key}": value for key, value in values.items()}
