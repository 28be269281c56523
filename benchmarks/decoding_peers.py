"""What decoders are compared with: the paper's recipe, the exact dense estimate, general solvers of least squares."""

from collections.abc import Callable

import numpy as np
from decoding_scenes import DEPTH_M, NOISE_STD, PITCH_M, SKIN, YOUNGS_PASCAL, grid
from numpy.typing import NDArray
from scipy import fft
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import LinearOperator, aslinearoperator, lsqr

from resonator_daemon.arrays import Complexes, Floats
from resonator_daemon.decoding.open_plane.decoder import SiteCovariance
from resonator_daemon.decoding.open_plane.prior_tables import StationaryPrior
from resonator_daemon.decoding.prior import Prior
from resonator_daemon.elastic import SpectralGrid
from simulators.half_space_fields import hertz_fields

try:
    import pylops
    from skimage.restoration import wiener
except ImportError:
    print("pylops and scikit-image are not installed: left out")
    pylops = wiener = None

Decode = Callable[[Floats], Floats]


def printed_recipe(side: int, rms_pascal: float) -> Decode:
    """Eq. (5) as printed: periodic, white prior of the traction's true mean power."""
    transfer = SpectralGrid((side, side), PITCH_M).transfer_matrix(SKIN, "sensor", "traction", DEPTH_M)
    adjoint = transfer.conj().swapaxes(-1, -2)
    inverse = adjoint @ np.linalg.inv(transfer @ adjoint + (NOISE_STD / rms_pascal) ** 2 * np.eye(3))

    def decode(frame: Floats) -> Floats:
        spectrum = np.moveaxis(fft.rfft2(frame.reshape(3, side, side)), 0, -1)[..., None]
        found = np.moveaxis((inverse @ spectrum)[..., 0], -1, 0)
        return np.asarray(fft.irfft2(found, s=(side, side)), np.float64)

    return decode


class DenseEstimates:
    """Single matrices of the open-plane estimate, C_fs (C_ss + R)^-1, solved without modes or symmetry."""

    def __init__(self, sites_m: Floats, queries_m: Floats) -> None:
        prior = StationaryPrior(SKIN, Prior(1e-3, 0.3), 1.0)
        covariance = SiteCovariance(prior, sites_m, np.full(len(sites_m), DEPTH_M))
        self._signals, self._traction = covariance.signals(), covariance.surface("traction", queries_m)

    def matrix(self, prior_std_pascal: float) -> NDArray[np.float32]:
        ridge = (NOISE_STD / prior_std_pascal) ** 2 * np.eye(len(self._signals))
        return np.ascontiguousarray(cho_solve(cho_factor(self._signals + ridge), self._traction.T).T, np.float32)


def periodic_operator(side: int) -> LinearOperator:
    spectral = SpectralGrid((side, side), PITCH_M)
    transfer = np.moveaxis(spectral.transfer_matrix(SKIN, "sensor", "traction", DEPTH_M), (2, 3), (0, 1))

    def apply(matrix: Complexes, field: Floats) -> Floats:
        spectrum = fft.rfft2(field.reshape(3, side, side))
        return np.asarray(fft.irfft2((matrix * spectrum).sum(axis=1), s=(side, side)), np.float64).ravel()

    adjoint = transfer.conj().swapaxes(0, 1)
    shape = (3 * side * side,) * 2
    return LinearOperator(shape, matvec=lambda f: apply(transfer, f), rmatvec=lambda s: apply(adjoint, s), dtype=float)


def pixel_operator(sites_m: Floats, side: int) -> LinearOperator:
    """Matrix from tractions on the pixels of a grid to signals anywhere: a pixel is four point loads."""
    matrix = np.zeros((3, side * side, 3, len(sites_m)))
    offset_m = PITCH_M / np.sqrt(12.0)
    for pixel, centre_m in enumerate(grid(side)):
        points = [centre_m + offset_m * np.array([x, y]) for x in (-1, 1) for y in (-1, 1)]
        places = np.concatenate([sites_m - point for point in points])
        fields = hertz_fields(places, DEPTH_M, [0.0], YOUNGS_PASCAL, 0.5)[0].reshape(3, 3, 4, -1)
        matrix[:, pixel] = fields.mean(axis=2) * PITCH_M**2 * np.array([[1.5 / YOUNGS_PASCAL], [1.0], [1.0]])
    return aslinearoperator(matrix.reshape(3 * side * side, -1).T)


def solvers(operator: LinearOperator, rms_pascal: float) -> dict[str, Decode]:
    """General solvers of least squares, with the ratio of noise to the traction's true rms as damping."""
    damp = NOISE_STD / rms_pascal
    found: dict[str, Decode] = {
        "scipy lsqr": lambda frame: np.asarray(lsqr(operator, frame.ravel(), damp=damp, iter_lim=60)[0], np.float64)
    }
    if pylops:
        wrapped, cgls = pylops.LinearOperator(operator), pylops.optimization.basic.cgls
        found["pylops cgls"] = lambda frame: np.asarray(cgls(wrapped, frame.ravel(), niter=30, damp=damp, tol=0.0)[0])
    return found


def channels_restored(side: int, frame: Floats, truth: Floats) -> dict[str, Decode]:
    """Wiener filter of scikit-image, one channel to one component, each with the balance that serves it best."""
    if not wiener:
        return {}
    transfer = SpectralGrid((side, side), PITCH_M).transfer_matrix(SKIN, "sensor", "traction", DEPTH_M)
    balances = (NOISE_STD / np.sqrt(np.mean(truth**2))) ** 2 * 10.0 ** np.arange(-2, 8)
    ways = []
    for channel, component in ((1, 0), (2, 1), (0, 2)):  # eps_xz to f_x, eps_yz to f_y, p_n to f_z
        scalar = transfer[..., channel, component].real.astype(complex)

        def restored(frame: Floats, balance: float, channel: int = channel, scalar: Complexes = scalar) -> Floats:
            image = frame.reshape(3, side, side)[channel]
            return np.asarray(wiener(image, scalar, balance, is_real=True, clip=False), np.float64)

        off = [np.linalg.norm(restored(frame, balance).ravel() - truth[component]) for balance in balances]
        ways.append((restored, balances[int(np.argmin(off))]))
    return {"scikit-image wiener": lambda frame: np.array([restored(frame, balance) for restored, balance in ways])}
