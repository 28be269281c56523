"""Tone readings straight from a board on its link, for a caller that waits in its own thread."""

from collections.abc import Iterator
from typing import Any

from resonator_daemon.base.plate import Plate
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.board_reader import BlockingReader
from resonator_daemon.board.session.compatibility import oscillator_hz
from resonator_daemon.board.session.frames import Arrival, BoardOnline, ChannelisedFrame, ReaderFailed, SingleToneFrame
from resonator_daemon.estimate.tones.tone_detector import ToneDetector, ToneReading, reading_frames
from resonator_daemon.measure.sensors.base import sensor_of

_TURN_S = 0.1


class ToneCapture(BlockingReader):
    """Reads a board from entry to exit, whichever unit the plate was calibrated with.

    Parameters
    ----------
    target
        Link of the board.
    plate
    fewest_frames
        Least number of frames in a reading.
    options
        Of `BoardReader`.
    """

    def __init__(self, target: LinkTarget, plate: Plate, *, fewest_frames: int = 1, **options: Any) -> None:
        self._sensor = sensor_of(plate)
        self._frames = reading_frames(1 / plate.counter.frame_rate_hz, fewest_frames)
        self._detector: ToneDetector | None = None
        any_unit = plate.calibration.model_copy(update={"unit": None})
        super().__init__(target, plate.model_copy(update={"calibration": any_unit}), **options)

    def arrivals(self) -> Iterator[tuple[Arrival | None, ToneReading | None]]:
        """Yield each arrival with the reading that it completes, and after each turn of 0.1 s at most None.

        Raises
        ------
        Exception
            What the reader's thread failed with.
        """
        while True:
            for arrival in self.wait(_TURN_S):
                yield arrival, self._reading(arrival)
            yield None, None

    def _reading(self, arrival: Arrival) -> ToneReading | None:
        match arrival:
            case BoardOnline() if self._detector is None:
                self._detector = self._sensor.tone_detector(self._frames, oscillator_hz(arrival.description))
            case SingleToneFrame() | ChannelisedFrame() if self._detector is not None:
                return self._detector.push(arrival)
            case ReaderFailed():
                raise arrival.error
        return None
