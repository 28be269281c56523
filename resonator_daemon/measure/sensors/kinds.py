"""The sensor that a plate amounts to, by its kind: each is a module of this package with a `SENSOR`."""

from importlib import import_module
from typing import Any

from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config.tables import Decoding, Measurement
from resonator_daemon.measure.sensors.base import Sensor


def sensor_of(plate: Plate, measurement: Measurement | None = None, decoding: Decoding | None = None) -> Sensor[Any]:
    """Return the sensor that a plate with its counter amounts to; settings that are not given have their defaults.

    Modules are imported when needed: decoding a skin loads much of scipy, for 0.5 s.
    """
    module = import_module(f"resonator_daemon.measure.sensors.{plate.sensor_kind.replace('-', '_')}")
    kind: type[Sensor[Any]] = module.SENSOR
    return kind(plate, measurement or Measurement(), decoding or Decoding())
