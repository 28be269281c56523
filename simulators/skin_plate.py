"""A plate under a soft skin: a partial-slip contact strains it, tones shift, a channelised counter measures them."""

import math
from collections import deque

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT
from firmware_protocol.messages import CounterKind, Description
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import Skin
from simulators.arrays import Floats, Singles
from simulators.contact import contact_radius_m, hertz_parts, pressed_signals, punch_parts
from simulators.normal_noise import normal_noise
from simulators.plate import (
    REFERENCE_ERROR,
    Contact,
    CountedFrame,
    attenuation_db256,
    corner_levels_db,
    gate_middles_s,
)
from simulators.pressed_surface import PressedSurface
from simulators.presses import FORCE_RANGE, RADIUS_MAX_M
from simulators.pressing import FRICTION_COEFFICIENT, RADIUS_M_AT_1_NEWTON, Pressing
from simulators.scenario import Scenario
from simulators.tone_records import ToneRecords, even_oscillators
from simulators.world import World

SIGNAL_TO_NOISE_DB = 30.0  # at 1 N without shear, rms over array and signals, corners combined
GAIN_ERROR = 0.01

_GATE_S = (4e-3, 100e-3)
_KEPT_BYTES = 16 * 1024 * 1024
_PRESSED_AHEAD = 12  # gates: pressing twelve takes hardly longer than pressing four


class SkinPlate:
    """Tones f0/(1 - s x) of sites that sense p_n, eps_xz and eps_yz under a paraboloid's touches, or a punch's.

    The sensitivity s of each tone is off by 1 % rms from that of the plate file. Noise is white. The best
    combination of the corners has a signal-to-noise ratio of 30 dB in the triple [3 p_n/(2 E), eps_xz, eps_yz], all
    three equally noisy, at the plate's own frame rate; each corner has its share by its level.
    """

    block_frames = 4

    def __init__(
        self, world: World, scenario: Scenario, seed: int, *, reference_error: float = REFERENCE_ERROR
    ) -> None:
        plate = world.plate
        if plate.skin is None:
            raise ValueError(f"plate {plate.name} has no [skin], the emulated channelised counter needs one")
        skin, tones = plate.skin, plate.tones
        oscillator_hz, spacing_hz = even_oscillators(plate)
        count = len(tones.f0_hz)
        reference_hz = plate.counter.reference_hz
        self.description = Description(
            counter_kind=CounterKind.CHANNELISED,
            channels=CHANNEL_COUNT,
            tones=count,
            reference_millihertz=round(reference_hz * 1e3),
            gate_ticks_min=round(_GATE_S[0] * reference_hz),
            gate_ticks_max=round(_GATE_S[1] * reference_hz),
            plate=plate.name,
            oscillator_millihertz=round(oscillator_hz[0] * 1e3),
            oscillator_spacing_millihertz=round(spacing_hz * 1e3),
        )
        self._scenario = scenario
        self._reference_hz = reference_hz
        self._tick_rate_hz = reference_hz * (1.0 + reference_error)
        self._random = np.random.default_rng(seed)
        noise_random, self._world_random = self._random.spawn(2)
        self._noise_bits = noise_random.bit_generator
        self._sites = len(plate.site_ids)
        self._signal_of_tone = tones.signal_index * self._sites + tones.site_index
        self._oscillator_hz = oscillator_hz
        self._half_spacing_hz = spacing_hz / 2.0
        # Counted against a fast reference, every frequency seems low.
        self._f0_hz = _alike(tones.f0_hz.T / (1.0 + reference_error))
        gain = 1.0 + self._random.normal(0.0, GAIN_ERROR, count)
        for signal, site in world.dead:
            gain[(tones.signal_index == signal) & (tones.site_index == site)] = 0.0
        self._sensitivity = _alike(tones.sensitivity.T * gain)
        self._still_hz = self._f0_hz - self._oscillator_hz
        self._common_walk, self._common_shift = world.common_walk, 0.0
        off_m = self._world_random.normal(0.0, 1e-3 * world.positions_mm, plate.site_positions_m.shape)
        self._surface = _surface(world, skin, scenario, plate.site_positions_m + off_m)
        self._parts = punch_parts if world.flat else hertz_parts
        # glibc keeps freed memory up to twice the largest block freed so far; else each frame faults its pages in anew.
        np.empty(_KEPT_BYTES, dtype=np.uint8)
        level_db = corner_levels_db(plate.site_positions_m[tones.site_index], plate.transducers_m, self._random).T
        self._own_gate_s = 1.0 / plate.counter.frame_rate_hz
        self._own_sigma_hz = self._noise_hz(plate, skin, level_db)
        self._attenuation = attenuation_db256(level_db)
        # Gates that follow: frequencies (1 or channels, tones) off the oscillators, and contacts; when they begin.
        self._ahead: deque[tuple[Floats, list[Contact]]] = deque()
        self._ahead_ticks = 0
        self._gate_ticks = 0  # of the following
        self._gate_s = 0.0
        self._noise_std: Singles  # (2, channels, tones), of a gate's offset in Hz and of its middle in turns
        self._records: ToneRecords
        self.start()

    def start(self) -> None:
        self._turns = self._random.random(self._own_sigma_hz.shape)

    def count(self, board_ticks: int, scenario_ticks: int, gate_ticks: int, frames: int) -> list[CountedFrame]:
        if gate_ticks != self._gate_ticks:
            self._set_gate(gate_ticks)
        if scenario_ticks != self._ahead_ticks or not self._scenario.fixed:
            self._ahead.clear()
        if len(self._ahead) < frames:
            self._press_ahead(scenario_ticks + len(self._ahead) * gate_ticks, frames)
        self._ahead_ticks = scenario_ticks + frames * gate_ticks
        gates = [self._ahead.popleft() for _ in range(frames)]
        return [CountedFrame(self._count_gate(true_hz), contacts) for true_hz, contacts in gates]

    def _press_ahead(self, scenario_ticks: int, frames: int) -> None:
        """Add so many gates, or more, to those whose frequencies are known."""
        if self._scenario.fixed:
            frames = max(frames, _PRESSED_AHEAD)
        pressing = self._scenario.at(gate_middles_s(scenario_ticks, self._gate_ticks, frames, self._tick_rate_hz))
        radii_m, parts_newton = self._parts(
            pressing.force_newton, pressing.radius_m_at_1_newton, pressing.friction_coefficient
        )
        true_hz = [self._still_hz] * frames
        if (pressed := pressing.force_newton[..., 2] > 0.0).any():
            signals = np.zeros((frames, 3, self._sites))
            for touch in np.flatnonzero(pressed.any(axis=0)):
                during = pressed[:, touch]
                x, y = pressing.position_m[0, touch].tolist()  # throughout: nothing slides on a skin
                signals[during] += self._surface.signals((x, y), radii_m[during, touch], parts_newton[during, touch])
            of_tones = signals.reshape(frames, -1).take(self._signal_of_tone, axis=1)
            true_hz = list(self._f0_hz / (1.0 - self._sensitivity * of_tones[:, np.newaxis]) - self._oscillator_hz)
        self._ahead += zip(true_hz, self._contacts(pressing, radii_m), strict=True)

    def _contacts(self, pressing: Pressing, radii_m: Floats) -> list[list[Contact]]:
        """Return what touches at each moment, with radii (frames, touches, 2) of contact and stick."""
        contacts = self._scenario.contacts(pressing)
        for frame, found in enumerate(contacts):
            touches = np.flatnonzero(pressing.force_newton[frame, :, 2])
            radii, frictions = radii_m[frame, touches].tolist(), pressing.friction_coefficient[touches].tolist()
            contacts[frame] = [
                contact._replace(radius_m=radius_m, stick_radius_m=stick_radius_m, friction_coefficient=friction)
                for contact, (radius_m, stick_radius_m), friction in zip(found, radii, frictions, strict=True)
            ]
        return contacts

    def _set_gate(self, gate_ticks: int) -> None:
        # White phase noise: the slope of a gate is off by length^(-3/2).
        self._gate_ticks = gate_ticks
        self._gate_s = gate_s = gate_ticks / self._reference_hz
        self._ahead.clear()
        sigma_hz = self._own_sigma_hz * (self._own_gate_s / gate_s) ** 1.5
        # The middle of a gate is off by length/sqrt(12) times the deviation of its slope.
        self._noise_std = np.stack([sigma_hz, sigma_hz * (gate_s / math.sqrt(12.0))]).astype(np.float32)
        self._records = ToneRecords(sigma_hz, self._attenuation, self._half_spacing_hz)

    def _count_gate(self, true_hz: Floats) -> list[bytes]:
        """Return the records of each channel in the next gate, for offsets (1 or channels, tones) of its tones."""
        noise = normal_noise(self._noise_bits, (2, *self._turns.shape))
        noise *= self._noise_std
        if self._common_walk:
            self._common_shift += self._common_walk * math.sqrt(self._gate_s) * self._world_random.standard_normal()
            true_hz = true_hz + self._f0_hz * self._common_shift
        offset_hz = true_hz + noise[0]
        middle_turns = self._turns + true_hz * (self._gate_s / 2.0)
        middle_turns += noise[1]
        self._turns += true_hz * self._gate_s
        self._turns -= np.floor(self._turns)
        return self._records.gate(offset_hz, middle_turns)

    def _noise_hz(self, plate: Plate, skin: Skin, level_db: Floats) -> Floats:
        """Return the standard deviation (channels, tones) of a tone's frequency in a gate of the plate's own length."""
        to_triple = np.array([1.5 / skin.youngs_modulus_pascal, 1.0, 1.0])
        centre = plate.site_positions_m.mean(axis=0)
        signals = pressed_signals(
            plate.site_positions_m,
            skin.depth_m,
            skin.youngs_modulus_pascal,
            skin.poisson_ratio,
            (centre[0], centre[1]),
            RADIUS_M_AT_1_NEWTON,
            FRICTION_COEFFICIENT,
            (0.0, 0.0, 1.0),
        )
        triple = signals * to_triple[:, np.newaxis]
        triple_std = math.sqrt((triple**2).mean()) * 10.0 ** (-SIGNAL_TO_NOISE_DB / 20.0)
        tones = plate.tones
        tone_std_hz = tones.f0_hz.T * np.abs(tones.sensitivity.T) * triple_std / to_triple[tones.signal_index]
        power = 10.0 ** (level_db / 10.0)
        sigma_hz: Floats = tone_std_hz / np.sqrt(power / power.sum(axis=0))
        return sigma_hz


def _alike(channels: Floats) -> Floats:
    """Return only the first of the channels (channels, tones) where they are all alike."""
    return channels[:1] if (channels == channels[0]).all() else channels


def _surface(world: World, skin: Skin, scenario: Scenario, positions_m: Floats) -> PressedSurface:
    """Return the surface of a skin with sites at `positions_m` (n, 2), for contacts anywhere within the outline."""
    plate = world.plate
    places = np.concatenate([plate.outline_m, positions_m])
    force_max_newton = max([FORCE_RANGE * plate.force_max_newton, *scenario.peak_newton])
    return PressedSurface(
        positions_m,
        skin.depth_m,
        skin.youngs_modulus_pascal,
        skin.poisson_ratio,
        float(np.hypot(*np.ptp(places, axis=0))),
        max(RADIUS_MAX_M, float(contact_radius_m(force_max_newton, RADIUS_M_AT_1_NEWTON))),
        punch=(1.0, 1.0) if world.flat else (0.0, -world.adhesion),
        thickness_m=1e-3 * world.layer,
    )
