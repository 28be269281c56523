"""Checks of the parameters that decoders share: each finite and above 0, or a ValueError that says what is wrong."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def check_prior(correlation_length_m: float, tangential_ratio: float, prior_std_pascal: float | None) -> None:
    """Refuse what makes no prior; its standard deviation may be None, for one chosen in each frame."""
    for name, value in (
        ("correlation_length_m", correlation_length_m),
        ("tangential_ratio", tangential_ratio),
        ("prior_std_pascal", 1.0 if prior_std_pascal is None else prior_std_pascal),
    ):
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} is {value}, must be finite and above 0")


def noise_of_signals(noise_std: ArrayLike, sites: tuple[int, ...]) -> Floats:
    """Broadcast to (3, *sites) what is given for all signals, by channel (3,), or for each."""
    std = np.asarray(noise_std, np.float64)
    by_channel = std.reshape(3, *[1] * len(sites)) if std.shape == (3,) else std
    return positive("noise_std", by_channel, (3, *sites))


def positive(name: str, values: Floats, shape: tuple[int, ...]) -> Floats:
    """Broadcast to `shape`."""
    try:
        whole = np.broadcast_to(values, shape)
    except ValueError:
        raise ValueError(f"{name} has shape {values.shape}, must broadcast to {shape}") from None
    if not ((whole > 0.0) & (whole < np.inf)).all():
        raise ValueError(f"{name} spans {whole.min()} .. {whole.max()}, must be finite and above 0")
    return whole
