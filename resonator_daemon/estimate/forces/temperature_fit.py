"""Temperature terms of sites from a sweep: a, b and c of y = a d + b d^2 + c d^3 about the reference temperature."""

from dataclasses import dataclass

import numpy as np

from resonator_daemon.base.arrays import Floats


@dataclass(frozen=True, eq=False, slots=True)
class TemperatureFit:
    """Coefficients (m, 3) of d, d^2 and d^3 in 1/K, 1/K^2 and 1/K^3, with their standard deviations."""

    coefficient: Floats
    coefficient_std: Floats


def fit_temperature(
    plate_kelvin: Floats,
    shift: Floats,
    shift_std: Floats,
    default: Floats,
    default_std: Floats,
    reference_kelvin: float,
) -> TemperatureFit:
    """Fit the shifts of sites untouched, or all the while under one load, at different plate temperatures.

    Parameters
    ----------
    plate_kelvin
        (n,) temperatures, changing so slowly that plate and thermometer agree.
    shift, shift_std
        (n, m) y = 1 - f0 / f by site, and its standard deviation (m,), relative. A constant is fitted to each site too.
    default, default_std
        (3,) coefficients of such plates and how they differ. They carry what the span of the sweep leaves open.
    """
    powers = (plate_kelvin - reference_kelvin)[:, None] ** np.array([1, 2, 3])
    centred = powers - powers.mean(axis=0)  # takes each site's constant out
    off_default = shift - shift.mean(axis=0) - (centred @ default)[:, None]
    scaled = centred * default_std
    # In units of default_std the prior is the identity.
    information = (scaled.T @ scaled) / shift_std[:, None, None] ** 2 + np.eye(3)
    right = (scaled.T @ off_default / shift_std**2).T
    covariance = np.linalg.inv(information)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    step = (covariance @ right[:, :, None])[:, :, 0]
    return TemperatureFit(default + step * default_std, std * default_std)
