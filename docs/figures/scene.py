"""The paper's example of section 4 in closed form: a paraboloid dragged on a skin, what it does, what sensors feel."""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from resonator_daemon.estimate.elastic.fields import SurfaceFields
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from simulators.contact import pixel_tractions
from simulators.half_space_fields import hertz_fields

Floats = NDArray[np.float64]

BODY = HalfSpace(2e5, 0.5)
DEPTH_M, PITCH_M, COUNT = 1e-3, 0.4e-3, 32
CURVATURE_RADIUS_M, RADIUS_M, FRICTION, STICK_RATIO = 20e-3, 3e-3, 0.5, 0.6
LOAD_NEWTON = (
    4.0 * BODY.youngs_modulus_pascal * RADIUS_M**3 / (3.0 * CURVATURE_RADIUS_M * (1.0 - BODY.poisson_ratio**2))
)
NOISE_DB = 11.0
FINER = 3  # pixels of the contact for each sensor, odd: one of them lies above it
EDGE_MM = COUNT * PITCH_M * 500.0
EXTENT_MM = (-EDGE_MM, EDGE_MM, EDGE_MM, -EDGE_MM)  # of an image whose row 0 is on top: y downwards

AXIS_M = (np.arange(COUNT) - (COUNT - 1) / 2.0) * PITCH_M
SITES_M = np.stack(np.meshgrid(AXIS_M, AXIS_M), axis=-1).reshape(-1, 2)


def signals(stick_ratio: float) -> Floats:
    """Signals [3 p_n / (2 E), eps_xz, eps_yz] at the sensors, (3, COUNT, COUNT)."""
    radii = RADIUS_M * np.array([1.0, stick_ratio])
    fields = hertz_fields(SITES_M, DEPTH_M, radii, BODY.youngs_modulus_pascal, BODY.poisson_ratio)
    sliding = FRICTION * LOAD_NEWTON
    forces = np.array([[sliding, 0.0, LOAD_NEWTON], [-sliding * stick_ratio**3, 0.0, 0.0]])
    felt = np.einsum("kf,kfsn->sn", forces, fields).reshape(3, COUNT, COUNT)
    felt[0] *= 1.5 / BODY.youngs_modulus_pascal
    return np.asarray(felt, np.float64)


def tractions(stick_ratio: float, finer: int = 1) -> Floats:
    """Means over square pixels, `finer` times as many per side as there are sensors."""
    force = (FRICTION * LOAD_NEWTON * (1.0 - stick_ratio**3), 0.0, LOAD_NEWTON)
    per_newton_m = RADIUS_M / float(np.cbrt(LOAD_NEWTON))
    count = finer * COUNT
    return pixel_tractions(force, (0.0, 0.0), per_newton_m, FRICTION, (count, count), PITCH_M / finer)


def displacements(stick_ratio: float) -> Floats:
    """Displacement of the surface above the sensors, from pixels fine enough to be exact to 2e-4."""
    count = FINER * COUNT
    fields = SurfaceFields(BODY, (count, count), PITCH_M / FINER, "displacement", 0.0)
    above = slice(FINER // 2, None, FINER)
    return fields(tractions(stick_ratio, FINER))[:, above, above]


def noise_spectrum() -> Floats:
    """Power of high-pass noise of variance 1 at each frequency of an `fft2`; w_c is a quarter of Nyquist's."""
    omega = 2.0 * np.pi * fft.fftfreq(COUNT)
    passed = (1.0 - np.exp(-(omega**2 + omega[:, None] ** 2) / (2.0 * (np.pi / 4.0) ** 2))) ** 2
    return np.asarray(passed / passed.mean(), np.float64)


def noise(rng: np.random.Generator) -> Floats:
    """High-pass noise of the three signals, of rms 1."""
    passed = fft.ifft2(fft.fft2(rng.standard_normal((3, COUNT, COUNT))) * np.sqrt(noise_spectrum())).real
    return np.asarray(passed / np.sqrt(np.mean(passed**2)), np.float64)


def noise_rms(decibel: float) -> float:
    """Noise so far below the rms of the three signals together, for the contact with `STICK_RATIO`."""
    return float(np.sqrt(np.mean(signals(STICK_RATIO) ** 2)) * 10.0 ** (-decibel / 20.0))


def error(found: Floats, truth: Floats) -> float:
    """Relative L2 error."""
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
