"""A board by definition whose channels may hear a second tone, be free of jitter, and go without being watched."""

import numpy as np
from brute_force_board import GATE_TICKS, REFERENCE_HZ, Board, Channel, record_of

PILOT_DB, TONE_DB = 85.0, 50.0  # below full scale


class _TwoTones(Channel):
    """Edges of the tone that is counted, moved by a weaker one that is `distance_hz` off."""

    jitter_ticks = 0.6
    ratio = 0.0
    distance_hz = 4000.0
    attenuation_db = PILOT_DB

    def gate(self, frequency_hz, end_ticks, flags=0):
        interval = self._stride * REFERENCE_HZ / frequency_hz
        count = int(np.ceil((end_ticks - self._next) / interval))
        ticks = self._next + interval * np.arange(count)
        beat = 2.0 * np.pi * (self.distance_hz * ticks / REFERENCE_HZ)
        ahead_s = np.angle(1.0 + self.ratio * np.exp(1j * beat)) / (2.0 * np.pi * frequency_hz)
        noisy = ticks - ahead_s * REFERENCE_HZ + self._rng.normal(0.0, self.jitter_ticks, count)
        record = record_of(np.floor(noisy).astype(np.int64).tolist(), self._edge, self._stride, flags)
        self._edge += count * self._stride
        self._next += interval * count
        return record._replace(attenuation_db256=round(256 * self.attenuation_db))

    def skip(self, ticks):
        self._next += ticks
        self._edge += round(ticks / 100.0)


class TwoToneBoard(Board):
    def __init__(self, seed=0):
        super().__init__(seed)
        for channel in self._channels:
            channel.__class__ = _TwoTones

    def hear(self, **state):
        """Set what channels hear, of each keyword one value for all or four."""
        for name, values in state.items():
            for channel, value in zip(self._channels, np.broadcast_to(values, 4).tolist(), strict=True):
                setattr(channel, name, value)

    def skip(self, frames):
        """Let time go by in which nobody counts."""
        self.sequence += frames
        self.board_ticks += frames * GATE_TICKS
        for channel in self._channels:
            channel.skip(frames * GATE_TICKS)
