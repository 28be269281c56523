"""A rigid paraboloid pressed into a square surface, with friction, and the load of Hertz for a contact radius."""

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.contact import FrictionalContact
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance

SIDE_M, A_M, R_M, G_PASCAL = 12.8e-3, 2.5e-3, 20e-3, 7e4


def body(nu: float) -> HalfSpace:
    return HalfSpace(2 * G_PASCAL * (1 + nu), nu)


def hertz_load(nu: float, radius_m: float = A_M) -> float:
    return 8 * G_PASCAL * radius_m**3 / (3 * R_M * (1 - nu))


def squared_radius(pixels: int, pitch_m: float) -> Floats:
    axis = (np.arange(pixels) - (pixels - 1) / 2) * pitch_m
    return axis**2 + axis[:, None] ** 2


def paraboloid(pixels: int, mu: float, nu: float, tolerance: float = 1e-8) -> FrictionalContact:
    pitch_m = SIDE_M / pixels
    compliance = SurfaceCompliance(body(nu), (pixels, pixels), pitch_m)
    return FrictionalContact(compliance, squared_radius(pixels, pitch_m) / (2 * R_M), mu, tolerance)
