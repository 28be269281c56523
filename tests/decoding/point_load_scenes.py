"""Scenes for the Fourier decoder: partial slip on a grid, signals from closed forms in space."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from sheared_contact import grid_positions

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding import Decoded, FourierDecoder
from resonator_daemon.elastic import HalfSpace
from simulators.contact import hertz_parts, pixel_tractions
from simulators.half_space_fields import hertz_fields

E = 2e5
PITCH, DEPTH = 4e-4, 1e-3
FORCE = 1.0


@dataclass(frozen=True)
class Scene:
    signals: Floats  # (3, ny, nx), without noise
    traction: Floats  # (3, ny, nx), averaged over the cell of each site

    def noise_std(self, decibel: float) -> float:
        return float(np.sqrt(np.mean(self.signals**2)) * 10 ** (-decibel / 20))

    def noisy(self, decibel: float, seed: int) -> Floats:
        return self.signals + self.noise_std(decibel) * np.random.default_rng(seed).standard_normal(self.signals.shape)

    def error(self, decoded: Decoded) -> float:
        return float(np.linalg.norm(decoded.traction_pascal - self.traction) / np.linalg.norm(self.traction))


def partial_slip(
    centre: tuple[float, float] = (0.0, 0.0),
    *,
    shape: tuple[int, int] = (32, 32),
    nu: float = 0.5,
    stick: float = 0.5,
    radius: float = 2.5e-3,
    direction: float = np.pi / 6,
) -> Scene:
    """Cattaneo and Mindlin: a contact that slips outside of a share of its radius."""
    shear = 0.5 * (1 - stick**3) * FORCE
    force = (shear * np.cos(direction), shear * np.sin(direction), FORCE)
    radii, forces = hertz_parts(force, radius, 0.5)
    fields = hertz_fields(grid_positions(shape) - centre, DEPTH, radii, E, nu)
    signals = np.einsum("kf,kfsn->sn", forces, fields) * np.array([[1.5 / E], [1.0], [1.0]])
    return Scene(signals.reshape(3, *shape), pixel_tractions(force, centre, radius, 0.5, shape, PITCH))


def decoder(scene: Scene, decibel: float, *, nu: float = 0.5, **keywords: Any) -> FourierDecoder:
    shape = scene.signals.shape[1:]
    return FourierDecoder(HalfSpace(E, nu), shape, PITCH, DEPTH, scene.noise_std(decibel), **keywords)
