"""Contacts in partial slip on skins, signals from closed forms in space; decoders and fits work on spectra."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fourier.decoder import FourierDecoder
from simulators.contact import hertz_parts, pixel_tractions
from simulators.half_space_fields import hertz_fields

E, NU, DEPTH_M, PITCH_M, FRICTION = 2e5, 0.5, 1e-3, 4e-4, 0.5
TO_TRIPLE = np.array([[1.5 / E], [1.0], [1.0]])  # pressure to the dimensionless signal of a site


def grid_positions(shape: tuple[int, int] = (32, 32)) -> Floats:
    """Sites row by row, x first, the origin in their middle, (ny nx, 2)."""
    x, y = ((np.arange(count) - (count - 1) / 2.0) * PITCH_M for count in shape[::-1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


SITES_M = grid_positions()


def hertz(sites_m: Floats, centre_m: Any, radius_m: float, depth_m: float = DEPTH_M, nu: float = NU) -> Floats:
    """Signals (3 forces, 3, n) of unit forces spread as Hertz's pressure; of point forces at the radius 0."""
    return np.asarray(hertz_fields(sites_m - centre_m, depth_m, [radius_m], E, nu)[0] * TO_TRIPLE, np.float64)


def contact_signals(
    sites_m: Floats,
    force_newton: Any,
    centre_m: Any,
    radius_m: float,
    *,
    friction: float = FRICTION,
    depth_m: float = DEPTH_M,
    nu: float = NU,
) -> Floats:
    """Signals (3, n) of a paraboloid in partial slip, pressed to a radius."""
    radii, forces = hertz_parts(force_newton, radius_m / np.cbrt(force_newton[2]), friction)
    fields = hertz_fields(sites_m - centre_m, depth_m, radii, E, nu)
    return np.asarray(np.einsum("kf,kfsn->sn", forces, fields) * TO_TRIPLE, np.float64)


def summed_points(centre_m: Any, axes_m: Floats, power: float, depth_m: float = DEPTH_M) -> Floats:
    """Signals (3 forces, 3, n) of unit forces over an ellipse, whose half-axes are the columns of `axes_m` (2, 2).

    Point loads on rings at r = sin(angle); the traction goes as (1 - r^2)^power.
    """
    nodes, weights = np.polynomial.legendre.leggauss(16)
    turns = np.arange(40) * 2.0 * np.pi / 40.0
    total = np.zeros((3, 3, len(SITES_M)))
    for angle, weight in zip((nodes + 1.0) * np.pi / 4.0, weights * np.pi / 4.0, strict=True):
        share = 2.0 * (power + 1.0) * weight * np.sin(angle) * np.cos(angle) ** (2.0 * power + 1.0) / len(turns)
        for turn in turns:
            place = centre_m + np.sin(angle) * (axes_m @ [np.cos(turn), np.sin(turn)])
            total += share * hertz(SITES_M, place, 0.0, depth_m)
    return total


def noise_std(signals: Floats, decibel: float) -> float:
    """Noise of a signal-to-noise ratio over all channels and sites."""
    return float(np.sqrt(np.mean(signals**2)) * 10.0 ** (-decibel / 20.0))


def noisy(signals: Floats, decibel: float, rng: np.random.Generator) -> Floats:
    return np.asarray(signals + noise_std(signals, decibel) * rng.standard_normal(signals.shape), np.float64)


@dataclass(frozen=True)
class Scene:
    signals: Floats  # (3, n) or (3, ny, nx), without noise
    traction: Floats  # of a grid: averaged over the cell of each site

    def frame(self, noise_std: float, seed: int) -> Floats:
        return self.signals + noise_std * np.random.default_rng(seed).standard_normal(self.signals.shape)

    def noisy(self, decibel: float, seed: int) -> Floats:
        return self.frame(noise_std(self.signals, decibel), seed)

    def error(self, found: Decoded | Floats) -> float:
        traction = found.traction_pascal if isinstance(found, Decoded) else found
        off = traction.reshape(self.traction.shape) - self.traction
        return float(np.linalg.norm(off) / np.linalg.norm(self.traction))


def scene(
    centre_m: tuple[float, float] = (0.0, 0.0),
    *,
    positions_m: Floats = SITES_M,
    depth_m: float = DEPTH_M,
    nu: float = NU,
    radius_m: float = 2.5e-3,
    direction: float = 0.0,
    force_newton: float = 1.0,
    stick_ratio: float = 0.5,
    shape: tuple[int, int] = (32, 32),
) -> Scene:
    """A contact that sticks within a share of its radius, its traction on a grid of a shape."""
    shear = FRICTION * (1.0 - stick_ratio**3) * force_newton
    force = (shear * np.cos(direction), shear * np.sin(direction), force_newton)
    signals = contact_signals(positions_m, force, centre_m, radius_m, depth_m=depth_m, nu=nu)
    traction = pixel_tractions(force, centre_m, radius_m / np.cbrt(force_newton), FRICTION, shape, PITCH_M)
    return Scene(signals, traction.reshape(3, -1))


def grid_scene(
    centre_m: tuple[float, float] = (0.0, 0.0), *, shape: tuple[int, int] = (32, 32), **contact: float
) -> Scene:
    """A scene whose arrays have the shape of the grid, sheared at 30 degrees unless said."""
    flat = scene(centre_m, positions_m=grid_positions(shape), shape=shape, **({"direction": np.pi / 6} | contact))  # type: ignore[arg-type]
    return Scene(flat.signals.reshape(3, *shape), flat.traction.reshape(3, *shape))


@functools.cache
def centred_noise(decibel: float) -> float:
    return noise_std(scene().signals, decibel)


def fourier_decoder(scene: Scene, decibel: float, *, nu: float = NU, **keywords: Any) -> FourierDecoder:
    noise = noise_std(scene.signals, decibel)
    return FourierDecoder(HalfSpace(E, nu), scene.signals.shape[1:], PITCH_M, DEPTH_M, noise, **keywords)


def disc_model() -> DiscModel:
    return DiscModel(HalfSpace(E, NU), SITES_M, DEPTH_M, 6e-3)


@dataclass(frozen=True)
class Contact:
    """One contact on the 32 x 32 grid, pressed with 1 N unless said."""

    centre_m: tuple[float, float]
    radius_m: float
    stick_ratio: float
    direction_rad: float
    mu: float = FRICTION
    normal_newton: float = 1.0

    @classmethod
    def random(cls, rng: np.random.Generator) -> "Contact":
        x, y = rng.uniform(-2.5e-3, 2.5e-3, 2)
        return cls((x, y), rng.uniform(2e-3, 3e-3), rng.uniform(0.3, 0.8), rng.uniform(0.0, 2.0 * np.pi))

    @property
    def force_newton(self) -> Floats:
        shear = self.mu * self.normal_newton * (1.0 - self.stick_ratio**3)
        return np.array([shear * np.cos(self.direction_rad), shear * np.sin(self.direction_rad), self.normal_newton])

    @property
    def signals(self) -> Floats:
        return contact_signals(SITES_M, self.force_newton, self.centre_m, self.radius_m, friction=self.mu)
