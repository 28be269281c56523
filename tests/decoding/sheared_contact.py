"""Scenes for decoders: a Cattaneo-Mindlin contact on a skin, from closed forms and the potentials of point loads."""

import functools
from dataclasses import dataclass

import numpy as np

from resonator_daemon.arrays import Floats
from simulators.contact import hertz_parts, pixel_tractions
from simulators.half_space_fields import hertz_fields

YOUNGS_PASCAL = 2e5
PITCH_M, DEPTH_M, RADIUS_M, FRICTION = 4e-4, 1e-3, 2.5e-3, 0.5


def grid_positions(shape: tuple[int, int] = (32, 32)) -> Floats:
    """Sites (ny nx, 2), rows along y, the origin in the middle."""
    x, y = ((np.arange(n) - (n - 1) / 2) * PITCH_M for n in (shape[1], shape[0]))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Scene:
    signals: Floats  # (3, n), without noise
    traction: Floats  # (3, n), averaged over the cell of each site of the 32 x 32 grid

    def frame(self, noise_std: float, seed: int) -> Floats:
        return self.signals + noise_std * np.random.default_rng(seed).standard_normal(self.signals.shape)

    def error(self, traction_pascal: Floats) -> float:
        off = traction_pascal.reshape(3, -1) - self.traction
        return float(np.linalg.norm(off) / np.linalg.norm(self.traction))


def scene(
    centre_m: tuple[float, float] = (0.0, 0.0),
    *,
    positions_m: Floats | None = None,
    depth_m: float = DEPTH_M,
    nu: float = 0.5,
    radius_m: float = RADIUS_M,
    direction: float = 0.0,
    force_newton: float = 1.0,
    stick_ratio: float = 0.5,
) -> Scene:
    shear = FRICTION * (1.0 - stick_ratio**3) * force_newton
    force = (shear * np.cos(direction), shear * np.sin(direction), force_newton)
    radius_m_at_1_newton = radius_m / np.cbrt(force_newton)
    positions = grid_positions() if positions_m is None else positions_m
    radii, forces = hertz_parts(force, radius_m_at_1_newton, FRICTION)
    fields = hertz_fields(positions - centre_m, depth_m, radii, YOUNGS_PASCAL, nu)
    signals = np.einsum("kf,kfsn->sn", forces, fields) * np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])
    traction = pixel_tractions(force, centre_m, radius_m_at_1_newton, FRICTION, (32, 32), PITCH_M)
    return Scene(signals, traction.reshape(3, -1))


@functools.cache
def noise_std(decibel: float) -> float:
    """Noise of a signal-to-noise ratio over all channels and sites of the centred scene."""
    return float(np.sqrt(np.mean(scene().signals ** 2)) * 10 ** (-decibel / 20))
