"""Sensor whose counter counts all tones of force sites at once."""

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.forces.force_sites import ForceTones
from resonator_daemon.estimate.tones.tone_detector import MultitoneDetector, ToneDetector
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones, force_tones
from resonator_daemon.measure.sensors.force_sensor import ForceSensor
from resonator_daemon.measure.sensors.multitone_processing import MultitoneProcessing
from resonator_daemon.measure.sensors.plate_sites import force_sites


class MultitoneSensor(ForceSensor):
    """Force sites, each with a tone that is always counted."""

    @property
    def expected_tones(self) -> ExpectedTones:
        return force_tones(self.plate)

    def tone_detector(self, frames: int, oscillator_hz: Floats) -> ToneDetector:
        return MultitoneDetector(frames, 1 / self.plate.counter.frame_rate_hz, oscillator_hz)

    def make_processing(self, oscillator_hz: Floats) -> MultitoneProcessing:
        plate, tones = self.plate, self.plate.tones
        return MultitoneProcessing(
            force_sites(plate),
            ForceTones(tones.f0_hz, tones.sensitivity, oscillator_hz, tones.site_index, tones.signal_index),
            reference_hz=plate.counter.reference_hz,
            gate_s=1 / plate.counter.frame_rate_hz,
            window_frames=self.window_frames,
            step_frames=self.step_frames,
            spread_width_m=plate.spread_width_m,
        )
