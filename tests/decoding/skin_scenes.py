"""A small skin and frames of contacts on it, from closed forms in space; the decoders work on spectra."""

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.skin import Skin
from resonator_daemon.elastic import HalfSpace
from simulators.contact import hertz_parts
from simulators.half_space_fields import hertz_fields

E, NU, DEPTH_M, PITCH_M = 2e5, 0.5, 1e-3, 4e-4
SHAPE = NY, NX = 12, 24
SITES = NY * NX
NOISE = np.tile([[6e-3], [4e-3], [3e-3]], SITES)  # some 30 dB below a newton
RADIUS_M, FRICTION = 1.2e-3, 0.5  # of contact at a newton


def grid(shape: tuple[int, int] = SHAPE) -> Floats:
    """Sites row by row, x first, the origin in their middle, (ny nx, 2)."""
    x, y = ((np.arange(count) - (count - 1) / 2.0) * PITCH_M for count in shape[::-1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


SITES_M = grid()
SKIN = Skin(HalfSpace(E, NU), SITES_M, DEPTH_M)


def press(
    normal_newton: float = 1.0,
    centre_m: tuple[float, float] = (0.0, 0.0),
    *,
    shear_newton: tuple[float, float] = (0.0, 0.0),
    radius_m_at_1_newton: float = RADIUS_M,
    friction: float = FRICTION,
    sites_m: Floats = SITES_M,
) -> Floats:
    """Signals (3, n) of a paraboloid in partial slip, without noise."""
    radii, forces = hertz_parts((*shear_newton, normal_newton), radius_m_at_1_newton, friction)
    fields = hertz_fields(sites_m - centre_m, DEPTH_M, radii, E, NU)
    to_triple = np.array([[1.5 / E], [1.0], [1.0]])
    return np.asarray(np.einsum("kf,kfsn->sn", forces, fields) * to_triple, np.float64)


def noisy(signals: Floats, rng: np.random.Generator, noise_std: Floats = NOISE) -> Floats:
    return np.asarray(signals + noise_std * rng.standard_normal(signals.shape), np.float64)
