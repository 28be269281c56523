"""The prior that suits a skin and what it touches, by the likelihood of captured frames."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Bools, Floats, Indices
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoded import SIGNAL_LIMIT, noise_of_signals
from resonator_daemon.estimate.surface.layout import as_grid
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.skin import DEFAULT_PRIOR, Prior

Place = tuple[int, int]  # in finest steps of log l and log r from the usual prior
Progress = Callable[[int, float, float], None]

_STEP = 2.0**0.25  # factor between neighbours of the finest search
_FIRST_STRIDE = 4  # finest steps at the start
_LONGEST = 16  # finest steps from the usual prior: a factor of 16 either way
_LOADED_STD = 5.0  # by which the energy of a frame with load exceeds that of noise


@dataclass(frozen=True)
class PriorFit:
    """Most likely prior. A standard deviation is infinite where the frames do not bound its quantity within the search.

    The search ends at a factor of 16 from the usual prior, l = 1 mm, r = 0.3.
    """

    correlation_length_m: float
    correlation_length_std_m: float
    tangential_ratio: float
    tangential_ratio_std: float
    log_evidence_gain: float  # over the usual prior, of all frames together
    frames_used: int  # those without load, with too few signals, or whose signals no load makes, are not


def fit_prior(
    half_space: HalfSpace,
    site_positions_m: ArrayLike,
    depth_m: ArrayLike,
    frames: ArrayLike,
    noise_std: ArrayLike,
    *,
    gain_std: float = 0.0,
    progress: Progress | None = None,
) -> PriorFit:
    """Maximise the likelihood over correlation length and tangential ratio, the scale being that of each frame.

    A compass search in log l and log r; a parabola through its last nine places gives the maximum. Standard deviations
    are the larger one of that by the likelihood's curvature and that by how the frames differ (White, Econometrica 50,
    1982, 1), since contacts are not drawn from the prior. They take frames as independent of each other: frames of one
    touch are not.

    Parameters
    ----------
    half_space, site_positions_m, depth_m, noise_std, gain_std
        As of `OpenPlaneDecoder`.
    frames
        Dimensionless signals, (k, 3, n).
    progress
        Called for each prior tried, with how many were, l in metres and r.

    Raises
    ------
    ValueError
        What `OpenPlaneDecoder` refuses, frames of another shape, or none with load.
    """
    sites = np.asarray(site_positions_m, np.float64)
    signals = np.asarray(frames, np.float64)
    if sites.ndim != 2 or signals.shape[1:] != (3, len(sites)):
        raise ValueError(f"frames have shape {signals.shape}, must be (k, 3, {len(sites)})")
    # The likelihood asks for no surface; on a grid the one at the sites is what lets it decode by symmetry.
    places = None if as_grid(sites) else sites[:1]
    tried: dict[Place, Floats] = {}

    def decoder(place: Place) -> OpenPlaneDecoder:
        length_m, ratio = _prior(np.array(place))
        return OpenPlaneDecoder(
            half_space,
            sites,
            depth_m,
            noise_std,
            gain_std=gain_std,
            query_positions_m=places,
            prior=Prior(float(length_m), float(ratio)),
        )

    usual = decoder((0, 0)).decode(signals)
    loaded = (usual.status == "ok") & has_load(signals, noise_std)
    used = int(np.count_nonzero(loaded))
    if not used:
        raise ValueError(f"0 of {len(signals)} frames hold load, must be at least 1: press and shear while capturing")
    tried[0, 0] = np.asarray(usual.log_evidence)[loaded]

    def likelihood(place: Place) -> Floats:
        """Of each frame; minus infinity beyond the search's limits."""
        if max(map(abs, place)) > _LONGEST:
            return np.full(used, -np.inf)
        if place not in tried:
            tried[place] = np.asarray(decoder(place).decode(signals[loaded]).log_evidence)
            if progress:
                progress(len(tried), *map(float, _prior(np.array(place))))
        return tried[place]

    best, stride = (0, 0), _FIRST_STRIDE
    while stride:
        around = [
            (best[0] + dx * stride, best[1] + dy * stride) for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
        ]
        ahead = max(around, key=lambda place: float(likelihood(place).sum()))
        if ahead == best:
            stride //= 2
        best = ahead
    summit, std = _summit(np.array([[likelihood((best[0] + i, best[1] + j)) for j in (-1, 0, 1)] for i in (-1, 0, 1)]))
    length_m, ratio = _prior(np.array(best) + summit)
    relative = std * np.log(_STEP)
    gain = float(likelihood(best).sum() - tried[0, 0].sum())
    return PriorFit(
        correlation_length_m=float(length_m),
        correlation_length_std_m=float(length_m * relative[0]),
        tangential_ratio=float(ratio),
        tangential_ratio_std=float(ratio * relative[1]),
        log_evidence_gain=gain,
        frames_used=used,
    )


def has_load(frames: ArrayLike, noise_std: ArrayLike) -> Bools:
    """Return which of the frames (k, 3, n) hold more than noise, by their energy over all known signals: (k,)."""
    signals = np.asarray(frames, np.float64)
    whitened = signals / noise_of_signals(noise_std, signals.shape[2:])
    known = np.abs(signals) <= SIGNAL_LIMIT
    count = known.sum(axis=(1, 2))
    energy = np.where(known, whitened, 0.0) ** 2
    return np.asarray(energy.sum(axis=(1, 2)) > count + _LOADED_STD * np.sqrt(2.0 * count), np.bool_)


def _prior(place: Floats | Indices) -> Floats:
    default = np.array([DEFAULT_PRIOR.correlation_length_m, DEFAULT_PRIOR.tangential_ratio])
    return np.asarray(default * _STEP ** np.asarray(place, np.float64), np.float64)


def _summit(likelihood: Floats) -> tuple[Floats, Floats]:
    """Return the maximum from the middle and its standard deviation, in steps, (2,) each, of (3, 3, frames)."""
    total = likelihood.sum(axis=2)
    if not np.isfinite(total).all():
        return np.zeros(2), np.full(2, np.inf)
    slopes = np.array([likelihood[2, 1] - likelihood[0, 1], likelihood[1, 2] - likelihood[1, 0]]) / 2.0
    bend = total[[2, 1], [1, 2]] + total[[0, 1], [1, 0]] - 2.0 * total[1, 1]
    twist = (total[2, 2] - total[2, 0] - total[0, 2] + total[0, 0]) / 4.0
    precision = -np.array([[bend[0], twist], [twist, bend[1]]])
    if not (np.linalg.eigvalsh(precision) > 0.0).all():
        return np.zeros(2), np.full(2, np.inf)
    covariance = np.linalg.inv(precision)
    step = np.clip(covariance @ slopes.sum(axis=1), -1.0, 1.0)
    at_summit = slopes - slopes.mean(axis=1, keepdims=True)
    scatter = covariance @ at_summit @ at_summit.T @ covariance
    return step, np.sqrt(np.maximum(np.diag(covariance), np.diag(scatter)))
