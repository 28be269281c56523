"""What decoders share: limits by which a frame is judged, and checks of parameters that raise a clear ValueError."""

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Floats

SIGNAL_LIMIT = 10.0  # a strain of ten: far beyond linear elasticity, only damage produces it
KNOWN_LIMIT = 0.5  # smallest share of known signals
CHI2_LIMIT = 100.0  # residual of ten times the declared noise ...
UNEXPLAINED_LIMIT = 0.5  # ... and of half the frame's energy: no load on a half-space makes such signals
GAIN_FLOOR = 1.5  # standard deviations of the gain that count as noise of the signals' rms


def check_gain(gain_std: float) -> None:
    """Refuse what is no relative standard deviation of gains."""
    if not 0.0 <= gain_std < 1.0:
        raise ValueError(f"gain_std is {gain_std}, must be at least 0 and below 1")


def positions(name: str, positions_m: ArrayLike) -> Floats:
    """Return the places (n, 2), at least one."""
    places = np.asarray(positions_m, np.float64)
    if places.ndim != 2 or places.shape[1] != 2 or not len(places):
        raise ValueError(f"{name} has shape {places.shape}, must be (n, 2), n at least 1")
    if not np.isfinite(places).all():
        raise ValueError(f"{name} holds {np.abs(places).max()}, must be finite")
    return places


def noise_of_signals(noise_std: ArrayLike, sites: tuple[int, ...]) -> Floats:
    """Broadcast to (3, *sites) what is given for all signals, by channel (3,), or for each."""
    std = np.asarray(noise_std, np.float64)
    by_channel = std.reshape(3, *[1] * len(sites)) if std.shape == (3,) else std
    return positive("noise_std", by_channel, (3, *sites))


def positive(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Broadcast values to a shape; ValueError where that cannot be, or for one that is not finite and above 0."""
    given = np.asarray(values, np.float64)
    try:
        whole = np.broadcast_to(given, shape)
    except ValueError:
        raise ValueError(f"{name} has shape {given.shape}, must broadcast to {shape}") from None
    if not ((whole > 0.0) & (whole < np.inf)).all():
        raise ValueError(f"{name} spans {whole.min()} .. {whole.max()}, must be finite and above 0")
    return whole
