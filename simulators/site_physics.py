"""Everything that force sites do besides eq. (1): hysteresis, creep, warmth, ageing, oscillator noise, scatter of K."""

from typing import Final, NamedTuple

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from simulators.arrays import Floats, Integers
from simulators.oscillator_noise import OscillatorNoise
from simulators.physics import Physics
from simulators.press_response import PressResponse
from simulators.site_temperature import SiteTemperature

_DAY_S: Final = 86_400.0


class SiteFrames(NamedTuple):
    """n gates of a plate's force sites; last column of (n, sites + 1): the pilot.

    A tone is at f0 (1 + relative_shift) / (1 - K sensitivity_factor felt_newton).
    """

    felt_newton: Floats  # (n, sites)
    relative_shift: Floats  # (n, sites + 1)
    phase_mean_s: Floats  # (n, sites + 1), of the oscillator noise within a gate: see GateNoise
    regression_excess: Floats  # (n, sites + 1), likewise
    sensitivity_factor: Floats  # (n, sites, channels)
    kelvin: Floats  # (n, sites)
    plate_kelvin: Floats  # (n,), where nothing touches it


class SitePhysics:
    """The force sites of one plate, in the order of its site_ids, and a pilot that nothing presses.

    Oscillators are those of sites, common to the corners. Temperature coefficients are the plate file's where it gives
    them. All else is as the scenario's physics has it, whatever response of its sites the file describes.
    """

    def __init__(self, plate: Plate, physics: Physics, random: np.random.Generator) -> None:
        coefficients_random, scatter_random, noise_random = random.spawn(3)
        sites = len(plate.site_ids)
        scatter = physics.sensitivity_scatter
        self._ageing = physics.ageing
        self._age_s = 0.0
        self._scatter = _TouchScatter(
            plate.calibration.model_error if scatter is None else scatter, sites, scatter_random
        )
        self._response = PressResponse(
            sites, physics.hysteresis_fraction * plate.force_max_newton, physics.creep_fraction, physics.creep_time_s
        )
        self._temperature = SiteTemperature(
            _temperature_coefficients(plate, physics, coefficients_random),
            physics.temperature_transient_s,
            plate.thermal.reference_kelvin,
            physics.contact_time_s,
        )
        self._noise = OscillatorNoise(
            sites + 1, physics.white_fm, physics.flicker_fm, physics.random_walk_fm, noise_random
        )

    def advance(
        self,
        dt_s: float,
        force_newton: Floats,
        contact_kelvin: Floats,
        touch_id: Integers,
        environment_kelvin: Floats,
    ) -> SiteFrames:
        """Go on by n gates.

        Parameters
        ----------
        dt_s
            Length of each gate.
        force_newton
            What presses each site, (n, sites).
        contact_kelvin
            Temperature of what touches each site, (n, sites); NaN where that changes nothing.
        touch_id
            The touch on each site, (n, sites); 0 for none.
        environment_kelvin
            Temperature around the plate, (n,).
        """
        gates = len(force_newton)
        age_s = self._age_s + dt_s * (np.arange(gates) + 0.5)
        self._age_s += dt_s * gates
        untouched = np.full((gates, 1), np.nan)
        warmth = self._temperature.advance(dt_s, environment_kelvin, np.hstack([contact_kelvin, untouched]))
        noise = self._noise.advance(dt_s, gates)
        ageing = self._ageing * np.log1p(age_s / _DAY_S)
        return SiteFrames(
            felt_newton=self._response.advance(dt_s, force_newton),
            relative_shift=warmth.relative_shift + ageing[:, np.newaxis] + noise.relative_shift,
            phase_mean_s=noise.phase_mean_s,
            regression_excess=noise.regression_excess,
            sensitivity_factor=self._scatter.factors(touch_id),
            kelvin=warmth.kelvin[:, :-1],
            plate_kelvin=warmth.kelvin[:, -1],
        )


class _TouchScatter:
    """1 + scatter for each touch, site and corner: the touch's number decides, however often it is asked for."""

    def __init__(self, std: float, sites: int, random: np.random.Generator) -> None:
        self._std = std
        self._shape = (sites, CHANNEL_COUNT)
        self._key = int(random.integers(2**63))
        self._by_touch: dict[int, Floats] = {}

    def factors(self, touch_id: Integers) -> Floats:
        """Return (n, sites, channels) for touches (n, sites); 1 where the touch is 0."""
        if not self._std:
            return np.broadcast_to(1.0, (len(touch_id), *self._shape))
        touches = set(touch_id.ravel().tolist()) - {0}
        if touches != self._by_touch.keys():
            self._by_touch = {touch: self._drawn(touch) for touch in touches}
        factors = np.ones((len(touch_id), *self._shape))
        for touch, factor in self._by_touch.items():
            np.copyto(factors, factor, where=(touch_id == touch)[..., np.newaxis])
        return factors

    def _drawn(self, touch: int) -> Floats:
        random = np.random.Generator(np.random.Philox(key=self._key | touch << 64))
        return 1.0 + self._std * random.standard_normal(self._shape)


def _temperature_coefficients(plate: Plate, physics: Physics, random: np.random.Generator) -> Floats:
    """Return a, b and c (sites + 1, 3) of every site and of the pilot."""
    sites = len(plate.site_ids)
    drawn = random.normal(physics.temperature_coefficient, physics.temperature_coefficient_std, sites + 1)
    coefficients = np.column_stack(
        [
            drawn,
            np.full(sites + 1, physics.temperature_quadratic),
            np.full(sites + 1, physics.temperature_cubic),
        ]
    )
    tones = plate.tones
    force = tones.signal_index == plate.signals.index(FORCE_SIGNAL)
    given = force & ~np.isnan(tones.temperature_coefficients).any(axis=1)
    coefficients[tones.site_index[given]] = tones.temperature_coefficients[given]
    return coefficients
