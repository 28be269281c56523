"""Sensor whose counter captures one tone per corner: the loudest, of the pilot or of a touched site."""

import math
from typing import Any, Final

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.tones.tone_detector import CapturedToneDetector, ToneDetector, capture_band_hz
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones, captured_tones
from resonator_daemon.measure.sensors.force_messages import site_codes
from resonator_daemon.measure.sensors.force_sensor import ForceSensor
from resonator_daemon.measure.sensors.plate_sites import findings, force_sites
from resonator_daemon.measure.sensors.single_tone_processing import SingleToneProcessing
from resonator_daemon.mqtt.payloads import SiteCode
from resonator_daemon.mqtt.topics import TONES, Topic

_ONSET_S: Final = 0.005  # an onset waits no longer for the frames after it


class SingleToneSensor(ForceSensor):
    """Force sites, of which the touched one takes the place of the pilot on each corner."""

    replaces = "single-tone"
    _processing: SingleToneProcessing | None = None

    @property
    def streams(self) -> tuple[Topic[Any], ...]:
        return *super().streams, TONES

    @property
    def problems(self) -> tuple[str, ...]:
        return findings(self.plate)

    @property
    def site_codes(self) -> tuple[SiteCode, ...]:
        return site_codes(self.plate)

    @property
    def pilot_hz(self) -> float:
        return self.plate.pilot_hz

    @property
    def wake_frames(self) -> tuple[int, ...]:
        onset_frames = max(1, round(_ONSET_S * self.plate.counter.frame_rate_hz))
        return (self.step_frames,) if self.step_frames <= onset_frames else (onset_frames, self.step_frames)

    @property
    def records_unusable(self) -> dict[str, int]:
        return dict(self._processing.unusable) if self._processing is not None else {}

    @property
    def expected_tones(self) -> ExpectedTones:
        return captured_tones(self.plate)

    def tone_detector(self, frames: int, oscillator_hz: Floats) -> ToneDetector:
        plate, counter = self.plate, self.plate.counter
        band_hz = capture_band_hz(plate.pilot_hz, plate.tones.f0_hz)
        return CapturedToneDetector(frames, counter.reference_hz, 1 / counter.frame_rate_hz, band_hz)

    def make_processing(self, oscillator_hz: Floats) -> SingleToneProcessing:
        plate = self.plate
        return SingleToneProcessing(
            force_sites(plate),
            pilot_hz=plate.pilot_hz,
            reference_hz=plate.counter.reference_hz,
            gate_s=1 / plate.counter.frame_rate_hz,
            window_frames=self.window_frames,
            step_frames=self.step_frames,
            load_sharing_exponent=plate.load_sharing_exponent,
            tones_period_frames=math.ceil(plate.counter.frame_rate_hz / (TONES.rate_max_hz or math.inf)),
        )
