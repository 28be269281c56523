"""Kind of sensor that reports the largest force alone: `sensor = "largest"` in the [counter] of a plate file."""

from collections.abc import Sequence
from dataclasses import replace

from resonator_daemon.board.session.frames import Frame
from resonator_daemon.estimate.forces.readings import ForceReading
from resonator_daemon.measure.sensors.multitone import MultitoneSensor


class LargestSensor(MultitoneSensor):
    """Force sites whose tones are all counted; `forces` has the site with the largest force."""

    @property
    def summary(self) -> str:
        return "measures the largest force"

    def measure(self, frames: Sequence[Frame]) -> Sequence[ForceReading]:
        return [
            replace(reading, sites=tuple(sorted(reading.sites, key=lambda force: -force.force_newton)[:1]))
            for reading in super().measure(frames)
        ]
