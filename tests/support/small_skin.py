"""A small skin of a channelised board: its tones, and the offsets that they send for given signals."""

import numpy as np

from resonator_daemon.measure.sensors.skin_processing import ToneArray

YOUNGS_MODULUS_PASCAL = 2e5
NY, NX = 8, 8
SITES, TONES = NY * NX, 3 * NY * NX
SENSITIVITY = np.array([-2.0e-11, 2.7e-6, -3.1e-6])


class Comb:
    """Tones of a small skin in a shuffled order, and the frequencies it sends for given signals."""

    def __init__(self, seed=0):
        rng = np.random.default_rng(seed)
        slots = rng.permutation(TONES)
        self.signal_index, self.site_index = slots // SITES, slots % SITES
        self.oscillator_hz = 100e6 + 3250.0 * np.arange(TONES)
        self.f0_hz = self.oscillator_hz[:, None] + rng.uniform(-300, 300, (TONES, 4))
        self.sensitivity = SENSITIVITY[self.signal_index][:, None] * rng.uniform(0.5, 1.5, (TONES, 4))
        self.sensitivity[:, 3] *= -1

    def array(self, **change):
        arguments = {
            "f0_hz": self.f0_hz,
            "sensitivity": self.sensitivity,
            "oscillator_hz": self.oscillator_hz,
            "site_index": self.site_index,
            "signal_index": self.signal_index,
            "youngs_modulus_pascal": YOUNGS_MODULUS_PASCAL,
        }
        return ToneArray(**(arguments | change))

    def offset_hz(self, physical, common_mode=0.0):
        """Offsets (4, t) for signals (3, sites) in Pa and strain, from (f - f0) / f = K s and a clock error."""
        value = physical[self.signal_index, self.site_index]
        f = self.f0_hz / (1 - self.sensitivity * value[:, None]) * (1 + common_mode)
        return (f - self.oscillator_hz[:, None]).T


def some_signals(seed=1):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(3, SITES)) * np.array([[2e4], [0.05], [0.05]])


def dimensionless(physical):
    return physical * np.array([[3 / (2 * YOUNGS_MODULUS_PASCAL)], [1.0], [1.0]])
