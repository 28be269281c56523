"""A quartz plate with one captured tone per corner: forces shift tones, corners capture, a counter sums time stamps."""

import numpy as np
import numpy.typing as npt

from firmware_protocol.layouts import CHANNEL_COUNT, SINGLE_TONE_FIELDS, RecordFlag
from firmware_protocol.messages import CounterKind, Description
from resonator_daemon.plate import Plate
from simulators.plate import (
    REFERENCE_ERROR,
    Contact,
    CountedFrame,
    attenuation_db256,
    corner_levels_db,
    gate_middles_s,
    record_type,
)
from simulators.scenario import Pressing, Scenario
from simulators.stamp_sums import StampCounter

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.intp]

_STRIDE_EDGES = 10
_GATE_S = (0.2e-3, 50e-3)  # a record counts at most 65535 stamps
_WHITE_FM = 3e-10  # Allan deviation of the oscillators at 1 s
_JITTER_S = 0.3e-9  # of the input itself
_NOISE_DB = -100.0
_AUDIBLE_DB = _NOISE_DB + 20.0 * np.log10(3.0)
_HYSTERESIS_DB = 1.0
_FULL_CONTACT_NEWTON = 20e-3
_SILENT = -1

_RECORD = record_type(SINGLE_TONE_FIELDS)


class QuartzPlate:
    """Ideal sites under a scenario's touches, as four corners hear them.

    A touch goes to the sites as distance^-exponent. A pressed site sounds at f0/(1 - K F), the louder the harder it
    is pressed: its level is that of `corner_levels_db` times F/20 mN, without saturation, so that the site that carries
    most dominates. Each corner counts the strongest tone it hears; another has to be 1 dB stronger to take over. While
    nothing is touched that is the pilot tone.

    The oscillators' white frequency noise is common to all channels and constant within a gate; a tone takes over
    between two gates. Shear is not felt.
    """

    block_frames = 40

    def __init__(
        self,
        plate: Plate,
        scenario: Scenario,
        seed: int,
        *,
        reference_error: float = REFERENCE_ERROR,
        pilot_level_db: float = -85.0,
    ) -> None:
        reference_hz = plate.counter.reference_hz
        self.description = Description(
            counter_kind=CounterKind.SINGLE_TONE,
            channels=CHANNEL_COUNT,
            tones=1,
            reference_millihertz=round(reference_hz * 1e3),
            gate_ticks_min=round(_GATE_S[0] * reference_hz),
            gate_ticks_max=round(_GATE_S[1] * reference_hz),
            plate=plate.name,
        )
        self._scenario = scenario
        self._tick_rate_hz = reference_hz * (1.0 + reference_error)
        self._random = np.random.default_rng(seed)
        # One row for each site and a last one for the pilot, which no force shifts.
        by_site = np.argsort(plate.tones.site_index)
        self._f0_hz = np.vstack([plate.tones.f0_hz[by_site], np.full(CHANNEL_COUNT, plate.pilot_hz)])
        self._sensitivity = np.vstack([plate.tones.sensitivity[by_site], np.zeros(CHANNEL_COUNT)])
        self._site_level_db = corner_levels_db(plate.site_positions_m, plate.transducers_m, self._random)
        self._pilot_level_db = pilot_level_db
        self._shares = _load_shares(scenario.positions_m, plate.site_positions_m, plate.load_sharing_exponent or np.inf)
        self.start()

    def start(self) -> None:
        self._stamps = StampCounter(CHANNEL_COUNT, _STRIDE_EDGES, self._random)
        self._captured = np.full(CHANNEL_COUNT, _SILENT, dtype=np.intp)

    def count(self, board_ticks: int, scenario_ticks: int, gate_ticks: int, frames: int) -> list[CountedFrame]:
        times_s = gate_middles_s(scenario_ticks, gate_ticks, frames, self._tick_rate_hz)
        pressing = self._scenario.at(times_s)
        force = np.zeros((frames, len(self._f0_hz)))
        force[:, :-1] = pressing.force_newton[..., 2] @ self._shares

        level_db = self._levels_db(force)
        captured = self._capture(level_db)
        before = np.vstack([self._captured, captured[:-1]])
        self._captured = captured[-1]

        silent = captured == _SILENT
        frame, channel = np.ogrid[:frames, :CHANNEL_COUNT]
        shift = self._sensitivity[captured, channel] * force[frame, captured]
        wander = self._random.normal(0.0, _WHITE_FM / np.sqrt(gate_ticks / self._tick_rate_hz), (frames, 1))
        frequency_hz = self._f0_hz[captured, channel] * (1.0 + wander) / (1.0 - shift)
        level_db = np.where(silent, _NOISE_DB, level_db[frame, captured, channel])
        noise_s = 10.0 ** ((_NOISE_DB - level_db) / 20.0) / (2.0 * np.pi * frequency_hz)
        broken = captured != before
        sums = self._stamps.count(
            board_ticks,
            gate_ticks,
            np.where(silent, np.inf, _STRIDE_EDGES * self._tick_rate_hz / frequency_hz),
            np.hypot(_JITTER_S, noise_s) * self._tick_rate_hz,
            broken,
        )

        records = np.zeros((frames, CHANNEL_COUNT), dtype=_RECORD)
        for name, value in sums._asdict().items():
            records[name] = value  # modulo 2^32 where the field has 32 bits
        records["stride_edges"] = _STRIDE_EDGES
        records["attenuation_db256"] = attenuation_db256(level_db)
        switched = (captured != before) & ~silent & (before != _SILENT)
        records["flags"] = (
            RecordFlag.CAPTURE_SWITCH * switched + RecordFlag.STRIDE_BREAK * broken + RecordFlag.NO_SIGNAL * silent
        )
        return [
            CountedFrame([record.tobytes() for record in records[index]], self._contacts(pressing, index))
            for index in range(frames)
        ]

    def _levels_db(self, force: FloatArray) -> FloatArray:
        """Level (frames, sites and pilot, channels) of every tone at every corner."""
        with np.errstate(divide="ignore"):
            activation_db = 20.0 * np.log10(force[:, :-1, np.newaxis] / _FULL_CONTACT_NEWTON)
        level_db = np.full((*force.shape, CHANNEL_COUNT), self._pilot_level_db)
        level_db[:, :-1] = activation_db + self._site_level_db
        return level_db

    def _capture(self, level_db: FloatArray) -> IndexArray:
        """Tone (frames, channels) that each corner counts: the strongest, unless the last one is nearly as strong."""
        strongest: IndexArray = level_db.argmax(axis=1)
        strongest[level_db.max(axis=1) < _AUDIBLE_DB] = _SILENT
        held = self._captured.copy()
        for frame, candidates in enumerate(strongest):
            if (candidates == held).all():
                continue
            for channel in np.flatnonzero(candidates != held):
                candidate, current = candidates[channel], held[channel]
                levels = level_db[frame, :, channel]
                if _SILENT in (candidate, current) or levels[candidate] > levels[current] + _HYSTERESIS_DB:
                    held[channel] = candidate
            candidates[:] = held
        return strongest

    def _contacts(self, pressing: Pressing, frame: int) -> list[Contact]:
        return [
            Contact(
                int(pressing.ids[frame, touch]),
                self._scenario.site_ids[touch],
                tuple(self._scenario.positions_m[touch].tolist()),
                tuple(pressing.force_newton[frame, touch].tolist()),
            )
            for touch in np.flatnonzero(pressing.force_newton[frame, :, 2])
        ]


def _load_shares(positions_m: FloatArray, site_positions_m: FloatArray, exponent: float) -> FloatArray:
    """Share (touches, sites) of each touch that each site carries; exactly on a site, all of it."""
    distance_m: FloatArray = np.linalg.norm(positions_m[:, np.newaxis] - site_positions_m, axis=-1)
    if not len(distance_m):
        return distance_m
    # Relative to the nearest site, so that a touch on a site is the limit and not a division by 0.
    nearest_m = np.maximum(distance_m.min(axis=1, keepdims=True), 1e-12)
    weight = (np.maximum(distance_m, 1e-12) / nearest_m) ** -exponent
    shares: FloatArray = weight / weight.sum(axis=1, keepdims=True)
    return shares
