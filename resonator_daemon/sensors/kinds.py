"""Table of the kinds of sensor."""

from importlib import import_module
from typing import Any, Final

from resonator_daemon.config import Decoding, Measurement
from resonator_daemon.plate import Plate
from resonator_daemon.sensors.base import Sensor

# Module and class of each kind. Modules are imported when needed: decoding a skin loads much of scipy, for 0.5 s.
SENSORS: Final = {
    "single-tone": ("single_tone", "SingleToneSensor"),
    "multitone": ("multitone", "MultitoneSensor"),
    "skin": ("skin", "SkinSensor"),
}


def sensor_of(plate: Plate, measurement: Measurement | None = None, decoding: Decoding | None = None) -> Sensor[Any]:
    """Return the sensor that a plate with its counter amounts to; settings that are not given have their defaults."""
    module, name = SENSORS[plate.sensor_kind]
    kind: type[Sensor[Any]] = getattr(import_module(f"resonator_daemon.sensors.{module}"), name)
    return kind(plate, measurement or Measurement(), decoding or Decoding())
