"""A board by definition: time stamps of edges written out one by one, and sums taken over them as the fields say."""

from collections.abc import Sequence

import numpy as np

from firmware_protocol.layouts import SINGLE_TONE_STRUCT, SingleToneRecord

REFERENCE_HZ = 1e9
GATE_TICKS = 1_000_000
PILOT_HZ = 10.01e6
WRAP = 1 << 32


def record_of(ticks: Sequence[int], first_edge: int, stride_edges: int, flags: int = 0) -> SingleToneRecord:
    """Sums over stamps given as unwrapped Python integers."""
    offsets = [int(t) - int(ticks[0]) for t in ticks]
    curvature = [offsets[k] - 2 * offsets[k - 1] + offsets[k - 2] for k in range(2, len(offsets))]
    return SingleToneRecord(
        first_edge=first_edge % WRAP,
        first_ticks=int(ticks[0]) % WRAP,
        stamps=len(offsets),
        stride_edges=stride_edges,
        span_ticks=offsets[-1],
        s1_ticks=sum(offsets),
        s2_ticks=sum(k * u for k, u in enumerate(offsets)),
        q2_ticks2=sum(c * c for c in curvature),
        attenuation_db256=0,
        flags=flags,
    )


def payload_of(records: Sequence[SingleToneRecord]) -> bytes:
    """Return records as they are on the wire."""
    return b"".join(SINGLE_TONE_STRUCT.pack(*record) for record in records)


class Channel:
    """One counter input; its phase runs on while the frequency changes from gate to gate."""

    def __init__(self, rng: np.random.Generator, stride_edges: int, first_edge: int, start_ticks: int) -> None:
        self._rng = rng
        self._stride = stride_edges
        self._edge = first_edge
        self._next = start_ticks + 1000 * rng.random()

    def gate(self, frequency_hz: float, end_ticks: int, flags: int = 0) -> SingleToneRecord:
        interval = self._stride * REFERENCE_HZ / frequency_hz
        count = int(np.ceil((end_ticks - self._next) / interval))
        times = self._next + interval * np.arange(count)
        ticks = np.floor(times + self._rng.normal(0, 0.6, count)).astype(np.int64).tolist()
        record = record_of(ticks, self._edge, self._stride, flags)
        self._edge += count * self._stride
        self._next += interval * count
        return record


class Board:
    """Four channels and the frame counters; edges and ticks start close to their wrap."""

    def __init__(self, seed: int = 0, stride_edges: int = 100) -> None:
        rng = np.random.default_rng(seed)
        self.sequence = -1
        self.board_ticks = WRAP - 30 * GATE_TICKS
        self._channels = [Channel(rng, stride_edges, WRAP - 100_000 * (c + 1), self.board_ticks) for c in range(4)]

    def frame(
        self, frequency_hz: Sequence[float], flags: Sequence[int] = (0, 0, 0, 0)
    ) -> tuple[int, int, list[SingleToneRecord]]:
        self.sequence += 1
        self.board_ticks += GATE_TICKS
        records = [
            channel.gate(float(f), self.board_ticks, flag)
            for channel, f, flag in zip(self._channels, frequency_hz, flags, strict=True)
        ]
        return self.sequence, self.board_ticks, records


class Ladder:
    """A plate like quartz16: codes 400 ppm apart, each corner pulled by up to 25 ppm, sensitivities spread by 30 %."""

    outline_m = np.array([[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]])
    force_max_newton = 10.0

    def __init__(self, seed: int = 1, *, pull: float = 25e-6, mixed_sign: bool = False) -> None:
        rng = np.random.default_rng(seed)
        code = rng.permutation(16) + 1
        self.code = code
        self.f0_hz = 10e6 * (1 - 400e-6 * code[:, None]) * (1 + rng.uniform(-pull, pull, (16, 4)))
        self.sensitivity = np.repeat(-6.3e-6 * rng.uniform(0.7, 1.3, (16, 1)), 4, axis=1)
        if mixed_sign:
            self.sensitivity = self.sensitivity * np.array([1, -1, 1, -1])
        grid = np.stack(np.meshgrid([-7.5e-3, -2.5e-3, 2.5e-3, 7.5e-3], [-7.5e-3, -2.5e-3, 2.5e-3, 7.5e-3]), axis=-1)
        self.positions_m = grid.reshape(16, 2) + rng.uniform(-7e-4, 7e-4, (16, 2))

    def loaded_hz(self, site: int, force_newton: float) -> np.ndarray:
        """Frequencies of the four corners from (f - f0) / f = K F."""
        return self.f0_hz[site] / (1 - self.sensitivity[site] * force_newton)
