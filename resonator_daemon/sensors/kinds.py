"""Table of the kinds of sensor."""

from typing import Any, Final

from resonator_daemon.config import Decoding, Measurement
from resonator_daemon.plate import Plate
from resonator_daemon.sensors.base import Sensor
from resonator_daemon.sensors.multitone import MultitoneSensor
from resonator_daemon.sensors.single_tone import SingleToneSensor
from resonator_daemon.sensors.skin import SkinSensor

SENSORS: Final[dict[str, type[Sensor[Any]]]] = {
    "single-tone": SingleToneSensor,
    "multitone": MultitoneSensor,
    "skin": SkinSensor,
}


def sensor_of(plate: Plate, measurement: Measurement | None = None, decoding: Decoding | None = None) -> Sensor[Any]:
    """Return the sensor that a plate with its counter amounts to; settings that are not given have their defaults."""
    return SENSORS[plate.sensor_kind](plate, measurement or Measurement(), decoding or Decoding())
