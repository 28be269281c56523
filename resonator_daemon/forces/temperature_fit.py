"""Temperature terms of sites from a sweep: a, b and c of y = a d + b d^2 + c d^3 about the reference temperature."""

from dataclasses import dataclass

import numpy as np

from resonator_daemon.arrays import Floats


@dataclass(frozen=True, eq=False, slots=True)
class TemperatureFit:
    """Coefficients (m, 3) of d, d^2 and d^3 in 1/K, 1/K^2 and 1/K^3, with their standard deviations.

    `fitted` (m, 3) is True where the sweep told the coefficient better than the usual one; the others are usual.
    """

    coefficient: Floats
    coefficient_std: Floats
    fitted: "np.ndarray[tuple[int, ...], np.dtype[np.bool_]]"
    kelvin_range: tuple[float, float]


def fit_temperature(
    plate_kelvin: Floats,
    shift: Floats,
    shift_std: Floats,
    usual: Floats,
    usual_std: Floats,
    reference_kelvin: float,
) -> TemperatureFit:
    """Fit the shifts of sites untouched, or all the while under one load, at different plate temperatures.

    Parameters
    ----------
    plate_kelvin
        (n,) temperatures, changing so slowly that plate and thermometer agree.
    shift, shift_std
        (n, m) y = 1 - f0 / f by site, and its standard deviation (m,), relative. A constant is fitted to each site too.
    usual, usual_std
        (3,) coefficients of such plates and how they differ. They carry what the span of the sweep leaves open.

    Raises
    ------
    ValueError
        Shapes that do not match, numbers that are not finite, or a standard deviation that is not above 0.
    """
    if shift.shape != (len(plate_kelvin), len(shift_std)) or usual.shape != (3,) or usual_std.shape != (3,):
        raise ValueError(
            f"shift {shift.shape} needs {len(plate_kelvin)} temperatures by {len(shift_std)} standard deviations; "
            f"usual {usual.shape} and usual_std {usual_std.shape} three values each"
        )
    if len(plate_kelvin) < 2 or not (np.isfinite(plate_kelvin).all() and np.isfinite(shift).all()):
        raise ValueError(f"{len(plate_kelvin)} readings; at least 2 are needed, and finite ones")
    if not ((shift_std > 0).all() and (usual_std > 0).all()):
        raise ValueError("shift_std and usual_std must be above 0")
    powers = (plate_kelvin - reference_kelvin)[:, None] ** np.array([1, 2, 3])
    centred = powers - powers.mean(axis=0)  # takes each site's constant out
    off_usual = shift - shift.mean(axis=0) - (centred @ usual)[:, None]
    scaled = centred * usual_std
    # In units of usual_std the prior is the identity.
    information = (scaled.T @ scaled) / shift_std[:, None, None] ** 2 + np.eye(3)
    right = (scaled.T @ off_usual / shift_std**2).T
    covariance = np.linalg.inv(information)
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    step = (covariance @ right[:, :, None])[:, :, 0]
    return TemperatureFit(
        coefficient=usual + step * usual_std,
        coefficient_std=std * usual_std,
        fitted=std < np.sqrt(0.5),
        kelvin_range=(float(plate_kelvin.min()), float(plate_kelvin.max())),
    )
