"""A small skin and frames of contacts on it, from closed forms in space; the decoders work on spectra."""

import numpy as np
from contact_scenes import DEPTH_M, NU, E, contact_signals, grid_positions

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.skin import Skin

SHAPE = NY, NX = 12, 24
SITES = NY * NX
NOISE = np.tile([[6e-3], [4e-3], [3e-3]], SITES)  # some 30 dB below a newton
RADIUS_M = 1.2e-3  # of contact at a newton
SITES_M = grid_positions(SHAPE)
SKIN = Skin(HalfSpace(E, NU), SITES_M, DEPTH_M)


def press(
    normal_newton: float = 1.0,
    centre_m: tuple[float, float] = (0.0, 0.0),
    *,
    shear_newton: tuple[float, float] = (0.0, 0.0),
    sites_m: Floats = SITES_M,
) -> Floats:
    """Signals (3, n) of a paraboloid in partial slip, without noise."""
    radius_m = RADIUS_M * np.cbrt(normal_newton)
    return contact_signals(sites_m, (*shear_newton, normal_newton), centre_m, radius_m)


def noisy(signals: Floats, rng: np.random.Generator, noise_std: Floats = NOISE) -> Floats:
    return np.asarray(signals + noise_std * rng.standard_normal(signals.shape), np.float64)
