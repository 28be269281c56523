"""Sixteen force sites under a cover as a channelised counter counts them, from frequencies written out here."""

import math

import numpy as np
from brute_force_board import Ladder

from resonator_daemon.estimate.forces.force_sites import ForceSites, ForceTones, Warmth
from resonator_daemon.measure.sensors.multitone import MultitoneProcessing

REFERENCE_HZ = 250e6
GATE_TICKS = 1_250_000
GATE_S = GATE_TICKS / REFERENCE_HZ
WIDTH_M = 2.5e-3
SITES = 16
POSITION_M = Ladder().positions_m
F0_HZ = (9.9e6 + 4000.0 * np.arange(SITES))[:, None] * (1 + 1e-6 * np.array([0.0, 20.0, -15.0, 5.0]))
K = -6.3e-6 * np.random.default_rng(3).uniform(0.7, 1.3, SITES)
SLOPE = -3e-7 * np.random.default_rng(4).uniform(0.8, 1.2, SITES)  # 1/K
SIGMA_HZ = 2.0 ** (-52 / 8)  # a gate of 5 ms at 100 dBHz
OSCILLATOR_HZ = 9.9e6 + 4000.0 * np.arange(SITES)
NOTHING = np.zeros(SITES)


def spread(newton, x_m, y_m):
    """Force on each site of a touch under a cover of depth w: F / (1 + r^2 / w^2)^(3/2)."""
    apart2 = ((POSITION_M - (x_m, y_m)) ** 2).sum(axis=1)
    return newton / (1 + apart2 / WIDTH_M**2) ** 1.5


class SmallComb:
    """A chain fed with frames, and the readings it gave."""

    def __init__(
        self,
        *,
        width_m=WIDTH_M,
        window_frames=2,
        step_frames=1,
        **calibration,
    ):
        self.rng = np.random.default_rng(0)
        self.sequence, self.board_ticks = -1, 10**9
        self.turns = self.rng.random((4, SITES))
        self.known = np.ones((4, SITES), dtype=bool)
        sites = ForceSites(
            F0_HZ,
            np.repeat(K[:, None], 4, axis=1),
            POSITION_M,
            Ladder.outline_m,
            10.0,
            Warmth(np.column_stack([SLOPE, NOTHING, NOTHING]), 2e-8, 0.0, NOTHING, 5.0),
            0.015,
            **calibration,
        )
        tones = ForceTones(
            F0_HZ, np.repeat(K[:, None], 4, axis=1), OSCILLATOR_HZ, np.arange(SITES), np.zeros(SITES, dtype=int)
        )
        self.chain = MultitoneProcessing(
            sites,
            tones,
            reference_hz=REFERENCE_HZ,
            gate_s=GATE_S,
            window_frames=window_frames,
            step_frames=step_frames,
            spread_width_m=width_m,
        )

    def arrays(self, load_newton, kelvin=0.0, offset=0.0):
        """Count one gate: f = f0 (1 + a d + o) / (1 - K F), phase without a break, white phase noise."""
        relative = (1 + SLOPE * kelvin + offset) / (1 - K * load_newton)
        offset_hz = F0_HZ.T * relative - OSCILLATOR_HZ
        middle = self.turns + offset_hz * GATE_S / 2
        self.turns = (self.turns + offset_hz * GATE_S) % 1.0
        noise = self.rng.standard_normal((2, 4, SITES))
        phase = (middle + SIGMA_HZ * GATE_S / math.sqrt(12.0) * noise[0]) % 1.0
        phase_turn32 = np.floor(phase * 2**32).astype(np.int64).astype(np.uint32).view(np.int32)
        offset_hz16 = np.rint((offset_hz + SIGMA_HZ * noise[1]) * 2**16).astype(np.int32)
        return phase_turn32, offset_hz16, np.full((4, SITES), 128 - 52, dtype=np.uint8), self.known.copy()

    def push(self, load_newton=NOTHING, **state):
        self.sequence += 1
        self.board_ticks += GATE_TICKS
        return self.chain.push(self.sequence, self.board_ticks, *self.arrays(load_newton, **state))

    def hold(self, load_newton=NOTHING, frames=20, **state):
        """Let the board count these loads for a while; returns the readings of that time."""
        given = [self.push(load_newton, **state) for _ in range(frames)]
        return [reading for reading in given if reading is not None]

    def lose(self, frames):
        """Let frames go missing in which nothing changes."""
        self.sequence += frames
        self.board_ticks += frames * GATE_TICKS

    def untouched(self, frames=100):
        readings = self.hold(frames=frames)
        assert readings[-1].status == "ok"
        assert readings[-1].contacts == ()
        return self
