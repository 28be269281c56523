"""A plate of force sites whose tones a channelised counter measures all at once, at every corner and all the time."""

import math

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT
from firmware_protocol.messages import CounterKind, Description
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL, TEMPERATURE_SIGNAL
from simulators.arrays import Floats
from simulators.plate import CountedFrame, attenuation_db256, corner_levels_db
from simulators.pressed_sites import PressedGates, PressedSites
from simulators.scenario import Scenario
from simulators.tone_records import ToneRecords, even_oscillators

_CARRIER_TO_NOISE_HZ = 1e10  # C/N0 of a tone at the corner where it is strongest: 100 dBHz
_GATE_S = (2e-3, 100e-3)


class CombPlate:
    """Sites under a cover that spreads a touch over them; each has a tone for its force, and may have one for warmth.

    A force tone is at f0 (1 + y)/(1 - K F), a temperature tone at f0 (1 + s (T - reference)), T the site's own. Noise
    is white phase noise of 100 dBHz at the corner where a tone is strongest, in the others by its level: the standard
    deviation of frequency is sqrt(6/(4 pi^2 C/N0 T^3)) over a gate T. The oscillators' own noise is common to the
    corners.
    """

    block_frames = 8

    def __init__(self, plate: Plate, scenario: Scenario, seed: int) -> None:
        if plate.counter.kind != "channelised" or FORCE_SIGNAL not in plate.signals:
            raise ValueError(
                f"plate {plate.name} has a {plate.counter.kind} counter and signals {', '.join(plate.signals)}; "
                "must be channelised and have force sites"
            )
        tones, reference_hz = plate.tones, plate.counter.reference_hz
        oscillator_hz, spacing_hz = even_oscillators(plate)
        self.description = Description(
            counter_kind=CounterKind.CHANNELISED,
            channels=CHANNEL_COUNT,
            tones=len(oscillator_hz),
            reference_millihertz=round(reference_hz * 1e3),
            gate_ticks_min=round(_GATE_S[0] * reference_hz),
            gate_ticks_max=round(_GATE_S[1] * reference_hz),
            plate=plate.name,
            oscillator_millihertz=round(oscillator_hz[0] * 1e3),
            oscillator_spacing_millihertz=round(spacing_hz * 1e3),
        )
        level_random, physics_random, self._random = np.random.default_rng(seed).spawn(3)
        self._sites = PressedSites(plate, scenario, physics_random)
        self._tones = tones
        self._force_tones, self._warm_tones = (
            np.flatnonzero([plate.signals[signal] == name for signal in tones.signal_index])
            for name in (FORCE_SIGNAL, TEMPERATURE_SIGNAL)
        )
        self._reference_kelvin = plate.thermal.reference_kelvin
        self._reference_hz = reference_hz
        self._reference_error = scenario.physics.reference_error
        self._oscillator_hz = oscillator_hz
        self._half_spacing_hz = abs(spacing_hz) / 2.0
        level_db = corner_levels_db(plate.site_positions_m, plate.transducers_m, level_random)[tones.site_index].T
        self._noise_ratio = 10.0 ** ((level_db.max(axis=0) - level_db) / 20.0)  # (channels, tones), of amplitudes
        self._attenuation = attenuation_db256(level_db)
        self._gate_ticks = 0  # of which there are records
        self._records: ToneRecords
        self.start()

    def start(self) -> None:
        self._turns = self._random.random(self._noise_ratio.shape)

    def count(self, board_ticks: int, scenario_ticks: int, gate_ticks: int, frames: int) -> list[CountedFrame]:
        gates = self._sites.advance(scenario_ticks, gate_ticks, frames)
        gate_s = gate_ticks / self._reference_hz
        # Counted against a fast reference, every frequency seems low.
        frequency_hz = self._frequencies_hz(gates) / (1.0 + self._reference_error)
        offset_hz = frequency_hz - self._oscillator_hz
        turns = np.concatenate([self._turns[np.newaxis], offset_hz * gate_s]).cumsum(axis=0)
        self._turns = turns[-1] % 1.0
        middle_turns = turns[:-1] + offset_hz * (gate_s / 2.0)
        # White frequency noise within a gate, as it affects a regression over that gate.
        force, site = self._force_tones, self._tones.site_index[self._force_tones]
        excess, strayed_s = gates.sites.regression_excess[:, site], gates.sites.phase_mean_s[:, site]
        offset_hz[..., force] += excess[:, np.newaxis] * frequency_hz[..., force]
        middle_turns[..., force] += strayed_s[:, np.newaxis] * frequency_hz[..., force]
        # White phase noise: the slope of a gate is off by length^(-3/2), its middle by length/sqrt(12) times that.
        sigma_hz = math.sqrt(6.0 / (4.0 * math.pi**2 * _CARRIER_TO_NOISE_HZ * gate_s**3)) * self._noise_ratio
        if gate_ticks != self._gate_ticks:
            self._gate_ticks = gate_ticks
            self._records = ToneRecords(sigma_hz, self._attenuation, self._half_spacing_hz)
        noise = self._random.standard_normal((frames, 2, *sigma_hz.shape))
        offset_hz += sigma_hz * noise[:, 0]
        middle_turns += sigma_hz * noise[:, 1] * (gate_s / math.sqrt(12.0))
        return [
            CountedFrame(self._records.gate(offset, middle), contacts, kelvin)
            for offset, middle, contacts, kelvin in zip(
                offset_hz, middle_turns, gates.contacts, gates.sites.plate_kelvin.tolist(), strict=True
            )
        ]

    def _frequencies_hz(self, gates: PressedGates) -> Floats:
        """Frequency (frames, channels, tones) of every tone in true hertz."""
        tones = self._tones
        frequency_hz = np.empty((len(gates.frequency_hz), CHANNEL_COUNT, len(tones.site_index)))
        force, warm = self._force_tones, self._warm_tones
        frequency_hz[..., force] = gates.frequency_hz[:, tones.site_index[force]].transpose(0, 2, 1)
        warmer_kelvin = gates.sites.kelvin[:, tones.site_index[warm]] - self._reference_kelvin
        frequency_hz[..., warm] = tones.f0_hz[warm].T * (1.0 + tones.sensitivity[warm].T * warmer_kelvin[:, np.newaxis])
        return frequency_hz
