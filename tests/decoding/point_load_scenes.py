"""Scenes for the Fourier decoder: partial slip, signals from superposed Boussinesq and Cerruti point loads."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding import Decoded, FourierDecoder
from resonator_daemon.elastic import HalfSpace

E = 2e5
PITCH, DEPTH = 4e-4, 1e-3
FORCE = 1.0


def sites(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """x and y of the sites, origin in the middle."""
    x, y = ((np.arange(n) - (n - 1) / 2) * PITCH for n in (shape[1], shape[0]))
    return np.meshgrid(x, y)


def point_load_signals(dx: Floats, dy: Floats, nu: float) -> Floats:
    """Signals at (dx, dy, DEPTH) of unit forces along x, y, z at the origin: (3 forces, 3 signals, ...)."""
    r, shear = np.sqrt(dx * dx + dy * dy + DEPTH**2), (1 + nu) / E
    p_n = -(1 + nu) / (3 * np.pi * r**3) * 1.5 / E
    tau = -3 / (2 * np.pi * r**5) * shear
    return np.array(
        [
            [p_n * dx, tau * dx * dx * DEPTH, tau * dx * dy * DEPTH],
            [p_n * dy, tau * dx * dy * DEPTH, tau * dy * dy * DEPTH],
            [p_n * DEPTH, tau * dx * DEPTH**2, tau * dy * DEPTH**2],
        ]
    )


def hertz_signals(x: Floats, y: Floats, radius: float, nu: float) -> Floats:
    """The same of tractions sqrt(1 - r^2 / radius^2), by quadrature over the disc."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    phi, angle = (nodes + 1) * np.pi / 4, np.arange(48) * (2 * np.pi / 48)
    signals = np.zeros((3, 3, *x.shape))
    for p, w in zip(phi, weights * np.pi / 4, strict=True):
        ring = w * 2 * np.pi / 48 * radius**2 * np.cos(p) ** 2 * np.sin(p)
        cos, sin = radius * np.sin(p) * np.cos(angle), radius * np.sin(p) * np.sin(angle)
        signals += ring * point_load_signals(x[..., None] - cos, y[..., None] - sin, nu).sum(axis=-1)
    return signals


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
    friction: float = 0.5,
    radius: float = 2.5e-3,
    direction: float = np.pi / 6,
) -> Scene:
    """Cattaneo and Mindlin: Hertz pressure, friction times pressure less the same over the stick radius."""
    x, y = (axis - middle for axis, middle in zip(sites(shape), centre, strict=True))
    peak = 1.5 * FORCE / (np.pi * radius**2)
    way = np.array([np.cos(direction), np.sin(direction)])
    whole = hertz_signals(x, y, radius, nu)
    inner = hertz_signals(x, y, stick * radius, nu)
    signals = peak * (whole[2] + friction * np.tensordot(way, whole[:2] - stick * inner[:2], 1))
    offset = ((np.arange(16) + 0.5) / 16 - 0.5) * PITCH
    square = (x[..., None, None] + offset) ** 2 + (y[..., None, None] + offset[:, None]) ** 2
    pressure = peak * np.sqrt(np.maximum(1 - square / radius**2, 0))
    shear = friction * (pressure - peak * stick * np.sqrt(np.maximum(1 - square / (stick * radius) ** 2, 0)))
    cells = np.array([way[0] * shear, way[1] * shear, pressure]).mean(axis=(-1, -2))
    return Scene(signals, cells)


def decoder(scene: Scene, decibel: float, *, nu: float = 0.5, **keywords: Any) -> FourierDecoder:
    shape = scene.signals.shape[1:]
    return FourierDecoder(HalfSpace(E, nu), shape, PITCH, DEPTH, scene.noise_std(decibel), **keywords)
