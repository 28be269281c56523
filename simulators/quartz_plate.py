"""A quartz plate with one captured tone per corner: forces shift tones, corners capture, a counter sums time stamps."""

from typing import Literal

import numpy as np
import numpy.typing as npt

from firmware_protocol.layouts import CHANNEL_COUNT, SINGLE_TONE_FIELDS, RecordFlag
from firmware_protocol.messages import CounterKind, Description
from resonator_daemon.base.plate import Plate
from simulators.arrays import Floats, Indices
from simulators.beats import INTERFERERS, Beats
from simulators.plate import CountedFrame, attenuation_db256, corner_levels_db, record_type
from simulators.pressed_sites import PressedSites
from simulators.scenario import Scenario
from simulators.stamp_sums import closed_form_sums
from simulators.stamps import stamped_sums
from simulators.strides import StampErrors, StampSums, StrideCounter

_STRIDE_EDGES = 10
_GATE_S = (0.2e-3, 50e-3)  # a record counts at most 65535 stamps
_AUDIBLE_RATIO = 3.0  # of a tone's amplitude to the noise's
_TAKEOVER_RATIO = 10.0 ** (1.0 / 20.0)  # of amplitudes, 1 dB
_CROWDED = 0.95  # what beats are made of where the other tones together are stronger than the captured one
_INAUDIBLE_BEAT = 1e-4  # of amplitudes: moves an edge by less than 2e-5 of a period
_SILENT = -1
_CAPTURE_SWITCH, _STRIDE_BREAK, _NO_SIGNAL = map(
    int, (RecordFlag.CAPTURE_SWITCH, RecordFlag.STRIDE_BREAK, RecordFlag.NO_SIGNAL)
)
_CHANNEL = np.arange(CHANNEL_COUNT)

_RECORD = record_type(SINGLE_TONE_FIELDS)


class QuartzPlate:
    """Sites under a scenario's touches, as received at four corners.

    A touch goes to the sites as distance^-exponent. A pressed site sounds at f0 (1 + y)/(1 - K F), F and y with the
    imperfections of the scenario's physics. Its level is that of `corner_levels_db`; below a force of
    `full_contact_newton` its amplitude is lower, in proportion to force. The way to a corner delays a tone by a
    constant time, which shifts no frequency.

    Each corner counts the strongest tone; another has to be 1 dB stronger to take over. While nothing is
    touched that is the pilot tone. The other tones displace the edges of the captured one by their beats. Where they
    are stronger than it, all together, an edge can be lost or found: such a record has the flag of another captured
    tone. Its sums are those of weaker beats.

    Frequency is constant within a gate but for what white noise does to a regression; a tone takes over between two
    gates. Shear is not felt.

    Parameters
    ----------
    counter
        "stamps" makes every time stamp, and is slow; "sums" draws their sums in closed form. The physics of both are
        the same for the same seed.
    """

    block_frames = 80

    def __init__(
        self, plate: Plate, scenario: Scenario, seed: int, *, counter: Literal["sums", "stamps"] = "sums"
    ) -> None:
        physics, reference_hz = scenario.physics, plate.counter.reference_hz
        self.description = Description(
            counter_kind=CounterKind.SINGLE_TONE,
            channels=CHANNEL_COUNT,
            tones=1,
            reference_millihertz=round(reference_hz * 1e3),
            gate_ticks_min=round(_GATE_S[0] * reference_hz),
            gate_ticks_max=round(_GATE_S[1] * reference_hz),
            plate=plate.name,
        )
        self._sums = {"sums": closed_form_sums, "stamps": stamped_sums}[counter]
        self._tick_rate_hz = reference_hz * (1.0 + physics.reference_error)
        level_random, physics_random, self._phase_random, self._stamp_random = np.random.default_rng(seed).spawn(4)
        self._sites = PressedSites(plate, scenario, physics_random)
        self._pilot_hz = plate.pilot_hz
        self._jitter_s = physics.jitter_s
        self._full_contact_newton = physics.full_contact_newton
        site_level_db = corner_levels_db(plate.site_positions_m, plate.transducers_m, level_random)
        self._full_amplitude = _amplitude(site_level_db)
        self._pilot_amplitude = _amplitude(physics.pilot_level_db)
        self._noise_amplitude = _amplitude(physics.noise_level_db)
        self.start()

    def start(self) -> None:
        self._strides = StrideCounter(CHANNEL_COUNT, _STRIDE_EDGES, self._phase_random)
        self._turns = self._phase_random.random((len(self._full_amplitude) + 1, CHANNEL_COUNT))  # of every tone
        self._captured = np.full(CHANNEL_COUNT, _SILENT, dtype=np.intp)

    def count(self, board_ticks: int, scenario_ticks: int, gate_ticks: int, frames: int) -> list[CountedFrame]:
        gates = self._sites.advance(scenario_ticks, gate_ticks, frames)
        sites = gates.sites
        # One row for each site and a last one for the pilot, which no force shifts.
        frequency_hz = np.empty((frames, *self._turns.shape))
        frequency_hz[:, :-1] = gates.frequency_hz
        frequency_hz[:, -1] = self._pilot_hz * (1.0 + sites.relative_shift[:, -1:])
        start_turns = self._start_turns(frequency_hz * (gate_ticks / self._tick_rate_hz))
        amplitude = self._amplitudes(gates.force_newton)
        captured = self._capture(amplitude)
        before = np.concatenate([self._captured[np.newaxis], captured[:-1]])
        self._captured = captured[-1]

        frame = np.arange(frames)[:, np.newaxis]
        silent, broken = captured == _SILENT, captured != before
        carrier_hz = frequency_hz[frame, captured, _CHANNEL]
        carrier_amplitude = np.where(silent, self._noise_amplitude, amplitude[frame, captured, _CHANNEL])
        strides = self._strides.count(
            board_ticks,
            gate_ticks,
            np.where(silent, np.inf, _STRIDE_EDGES * self._tick_rate_hz / carrier_hz),
            broken,
        )
        noise_s = self._noise_amplitude / carrier_amplitude / (2.0 * np.pi * carrier_hz)
        errors = StampErrors(
            np.hypot(self._jitter_s, noise_s) * self._tick_rate_hz,
            # A phase that is ahead brings its edges early.
            sites.phase_mean_s[frame, captured] * -self._tick_rate_hz,
            sites.regression_excess[frame, captured] * -gate_ticks,
        )
        ratio = amplitude / carrier_amplitude[:, np.newaxis]
        ratio[frame, captured, _CHANNEL] = 0.0
        crowded = (ratio.sum(axis=1) >= 1.0) & ~silent
        beats = self._beats(ratio, frequency_hz, start_turns, captured)
        sums = self._sums(strides, errors, beats, self._stamp_random)
        flags = (
            _CAPTURE_SWITCH * ((broken & ~silent & (before != _SILENT)) | crowded)
            + _STRIDE_BREAK * broken
            + _NO_SIGNAL * silent
        )
        records = _records(sums, attenuation_db256(20.0 * np.log10(carrier_amplitude)), flags)
        return list(map(CountedFrame, records, gates.contacts, sites.plate_kelvin.tolist()))

    def _start_turns(self, gate_turns: Floats) -> Floats:
        """Phase of every tone at the start of each gate, from the turns it makes; goes on from call to call."""
        turns = np.concatenate([self._turns[np.newaxis], gate_turns])
        turns -= np.floor(turns)
        turns = turns.cumsum(axis=0)
        self._turns = turns[-1] % 1.0
        return turns[:-1]

    def _amplitudes(self, force_newton: Floats) -> Floats:
        """Amplitude (frames, sites and pilot, channels) of every tone at every corner."""
        activation = np.minimum(force_newton / self._full_contact_newton, 1.0)
        amplitude = np.full((len(force_newton), *self._turns.shape), self._pilot_amplitude)
        np.multiply(activation[..., np.newaxis], self._full_amplitude, out=amplitude[:, :-1])
        return amplitude

    def _capture(self, amplitude: Floats) -> Indices:
        """Tone (frames, channels) that each corner counts: the strongest, unless the last one is nearly as strong."""
        strongest: Indices = amplitude.argmax(axis=1)
        strongest[amplitude.max(axis=1) < _AUDIBLE_RATIO * self._noise_amplitude] = _SILENT
        if (strongest == self._captured).all():
            return strongest
        held = self._captured.copy()
        for frame, candidates in enumerate(strongest):
            if (candidates == held).all():
                continue
            for channel in np.flatnonzero(candidates != held):
                candidate, current = candidates[channel], held[channel]
                levels = amplitude[frame, :, channel]
                if _SILENT in (candidate, current) or levels[candidate] > levels[current] * _TAKEOVER_RATIO:
                    held[channel] = candidate
            candidates[:] = held
        return strongest

    def _beats(self, ratio: Floats, frequency_hz: Floats, start_turns: Floats, captured: Indices) -> Beats | None:
        """Beats of the strongest other tones, of amplitude `ratio` (frames, tones, channels) to the captured one's."""
        if ratio.max() < _INAUDIBLE_BEAT:
            return None
        if (missing := INTERFERERS - ratio.shape[1]) > 0:  # a plate of one site and its pilot
            padding = ((0, 0), (0, missing), (0, 0))
            ratio = np.pad(ratio, padding)
            frequency_hz, start_turns = (np.pad(values, padding, mode="edge") for values in (frequency_hz, start_turns))
        frame = np.arange(len(ratio))[:, np.newaxis]
        strongest = ratio.argsort(axis=1)[:, : -INTERFERERS - 1 : -1].transpose(0, 2, 1)
        which = frame[..., np.newaxis], strongest, _CHANNEL[:, np.newaxis]
        chosen = ratio[which]
        together = chosen.sum(axis=-1, keepdims=True)
        carrier_hz = frequency_hz[frame, captured, _CHANNEL]
        return Beats(
            chosen * np.minimum(1.0, _CROWDED / np.maximum(together, _CROWDED)),
            start_turns[which] - start_turns[frame, captured, _CHANNEL][..., np.newaxis],
            (frequency_hz[which] - carrier_hz[..., np.newaxis]) / self._tick_rate_hz,
            carrier_hz / self._tick_rate_hz,
        )


def _amplitude(level_db: npt.ArrayLike) -> Floats:
    amplitude: Floats = 10.0 ** (np.asarray(level_db) / 20.0)
    return amplitude


def _records(sums: StampSums, attenuation: npt.NDArray[np.uint16], flags: npt.NDArray[np.integer]) -> list[list[bytes]]:
    """Return the records of each frame as the wire has them."""
    records = np.zeros(flags.shape, dtype=_RECORD)
    for name, value in sums._asdict().items():
        records[name] = value  # modulo 2^32 where the field has 32 bits
    records["stride_edges"] = _STRIDE_EDGES
    records["attenuation_db256"] = attenuation
    records["flags"] = flags
    size, data = _RECORD.itemsize, records.tobytes()
    channels = [data[at : at + size] for at in range(0, len(data), size)]
    return [channels[at : at + CHANNEL_COUNT] for at in range(0, len(channels), CHANNEL_COUNT)]
