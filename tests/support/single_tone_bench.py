"""A single-tone chain fed by a board of brute force, with the readings that it gave."""

import numpy as np
from brute_force_board import GATE_TICKS, PILOT_HZ, REFERENCE_HZ, Board, Ladder, payload_of

from firmware_protocol.layouts import RecordFlag
from resonator_daemon.estimate.forces.force_sites import ForceSites, Warmth
from resonator_daemon.measure.sensors.single_tone_processing import SingleToneProcessing

NO_SIGNAL = int(RecordFlag.NO_SIGNAL)
PLATE = Ladder()
UNTOUCHED = np.full(4, PILOT_HZ)
CLOCK_ERROR = 3e-5


class Bench:
    """A chain fed by a board, with the readings it gave."""

    def __init__(
        self,
        plate=PLATE,
        *,
        window_frames=10,
        step_frames=5,
        error=0.0,
        board=None,
        tones_period_frames=None,
        **calibration,
    ):
        self.board = board or Board()
        self.error = error
        self.readings = []
        warmth = Warmth(np.zeros((16, 3)), 0.0, -2e-7, np.zeros(16), 5.0)
        sites = ForceSites(
            plate.f0_hz,
            plate.sensitivity,
            plate.positions_m,
            plate.outline_m,
            plate.force_max_newton,
            warmth,
            0.015,
            **calibration,
        )
        self.chain = SingleToneProcessing(
            sites,
            pilot_hz=PILOT_HZ,
            reference_hz=REFERENCE_HZ,
            gate_s=GATE_TICKS / REFERENCE_HZ,
            window_frames=window_frames,
            step_frames=step_frames,
            tones_period_frames=tones_period_frames,
        )

    def hold(self, frequency_hz, frames, flags=(0, 0, 0, 0)):
        """Let the board count these frequencies for a while; returns the readings of that time."""
        return self.play([frequency_hz] * frames, flags)

    def play(self, frequencies, flags=(0, 0, 0, 0)):
        before = len(self.readings)
        for frequency in frequencies:
            self.readings += self.push(*self.board.frame(np.asarray(frequency) * (1 + self.error), flags))
        return self.readings[before:]

    def push(self, sequence, ticks, records):
        """Give the chain one frame; returns its reading in a list, or none."""
        return self.chain.push(sequence, [ticks], payload_of(records))

    def lose(self, frequency_hz, frames):
        for _ in range(frames):
            self.board.frame(np.asarray(frequency_hz) * (1 + self.error))

    def untouched(self):
        """Hear the pilot until the common mode is known."""
        assert self.hold(UNTOUCHED, 200)[-1].status == "ok"
        return self


def events(readings):
    return [(event.event, event.contact.touch.site) for reading in readings for event in reading.events]
