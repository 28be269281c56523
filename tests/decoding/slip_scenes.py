"""Frames of a paraboloid in partial slip on a 32 x 32 skin, from closed forms in space; the fits work on spectra."""

from dataclasses import dataclass

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.fitting.contact_model import DiscModel
from resonator_daemon.elastic import HalfSpace
from simulators.contact import hertz_parts
from simulators.half_space_fields import hertz_fields

E, NU, DEPTH_M, PITCH_M = 2e5, 0.5, 1e-3, 4e-4
TO_TRIPLE = np.array([[1.5 / E], [1.0], [1.0]])


def grid(count: int = 32) -> Floats:
    """Sites row by row, x first, the origin in their middle, (count^2, 2)."""
    axis = (np.arange(count) - (count - 1) / 2.0) * PITCH_M
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


SITES_M = grid()


def model(youngs_modulus_pascal: float = E, depth_m: float = DEPTH_M) -> DiscModel:
    return DiscModel(HalfSpace(youngs_modulus_pascal, NU), SITES_M, depth_m, 6e-3)


@dataclass(frozen=True)
class Scene:
    """One contact, pressed with 1 N unless said."""

    centre_m: tuple[float, float]
    radius_m: float
    stick_ratio: float
    direction_rad: float
    mu: float = 0.5
    normal_newton: float = 1.0

    @classmethod
    def random(cls, rng: np.random.Generator) -> "Scene":
        """Draw one with a 2 .. 3 mm and c/a 0.3 .. 0.8."""
        x, y = rng.uniform(-2.5e-3, 2.5e-3, 2)
        return cls((x, y), rng.uniform(2e-3, 3e-3), rng.uniform(0.3, 0.8), rng.uniform(0.0, 2.0 * np.pi))

    @property
    def force_newton(self) -> Floats:
        shear = self.mu * self.normal_newton * (1.0 - self.stick_ratio**3)
        return np.array([shear * np.cos(self.direction_rad), shear * np.sin(self.direction_rad), self.normal_newton])

    @property
    def signals(self) -> Floats:
        """(3, n), without noise."""
        radii, forces = hertz_parts(self.force_newton, self.radius_m / np.cbrt(self.normal_newton), self.mu)
        fields = hertz_fields(SITES_M - self.centre_m, DEPTH_M, radii, E, NU)
        return np.asarray(np.einsum("kf,kfsn->sn", forces, fields) * TO_TRIPLE, np.float64)


def noise_std(signals: Floats, decibel: float) -> float:
    return float(np.sqrt(np.mean(signals**2)) * 10.0 ** (-decibel / 20.0))


def noisy(signals: Floats, decibel: float, rng: np.random.Generator) -> Floats:
    return np.asarray(signals + noise_std(signals, decibel) * rng.standard_normal(signals.shape), np.float64)
