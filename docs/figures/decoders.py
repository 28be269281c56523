"""What the figures of decoding compare: the paper's two inverses, and decoders of this project."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scene import BODY, COUNT, DEPTH_M, FRICTION, PITCH_M, SITES_M
from scipy import fft

from resonator_daemon.estimate.elastic.fields import SurfaceFields
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.surface.contact_physics.decoder import ContactDecoder
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

GRID = SpectralGrid((COUNT, COUNT), PITCH_M)
TRANSFER = GRID.transfer_matrix(BODY, "sensor", "traction", DEPTH_M)
COMPLIANCE = GRID.transfer_matrix(BODY, "displacement", "traction", 0.0)
AT_SENSORS = SurfaceFields(BODY, (COUNT, COUNT), PITCH_M, "displacement", 0.0)  # of tractions at their pitch


def filtered(matrices: Complexes, signals: Floats) -> Floats:
    """Fields of the signals, each frequency sent through its matrix, as if all repeated with the array's period."""
    spectrum = np.moveaxis(fft.rfft2(signals), 0, -1)[..., None]
    return np.asarray(fft.irfft2(np.moveaxis((matrices @ spectrum)[..., 0], -1, 0), s=(COUNT, COUNT)), np.float64)


def wiener(noise_over_prior: ArrayLike) -> Complexes:
    """Eq. (5) with P_s = q I and P_n = p I, from p / q at each frequency."""
    adjoint = TRANSFER.conj().swapaxes(-1, -2)
    ratio = np.asarray(noise_over_prior, np.float64)[..., None, None]
    return np.asarray(adjoint @ np.linalg.inv(TRANSFER @ adjoint + ratio * np.eye(3)), np.complex128)


class Decoders:
    """Decoders for one noise: their set-up takes seconds, so that figures bring their signals to this noise."""

    def __init__(self, noise_std: float) -> None:
        self.noise_std = noise_std
        self.open_plane = OpenPlaneDecoder(BODY, SITES_M, DEPTH_M, noise_std)
        self._contact = {mu: ContactDecoder(self.open_plane, mu) for mu in (None, FRICTION)}

    def contact(self, signals: Floats, friction: float | None) -> Floats:
        """Traction of a frame that has none before it."""
        self._contact[friction].reset()
        return self._contact[friction].decode(signals).traction_pascal
