"""Prior of the traction on a skin: what loads are expected to look like before a frame is seen."""

from dataclasses import dataclass

import numpy as np

from resonator_daemon.base.arrays import Floats


@dataclass(frozen=True)
class Prior:
    """Smooth stationary Gaussian prior of the traction.

    Its power spectrum is that of f_z times (r, r, 1) for x, y, z. The covariance of f_z at a distance d is
    (d / l) K_1(d / l) times the variance.

    Parameters
    ----------
    correlation_length_m
        l, above 0; between 0.5 and 2 mm results hardly change for sites 1 mm deep.
    tangential_ratio
        r, power of f_x and of f_y over that of f_z; above 0.
    std_pascal
        Standard deviation of f_z, above 0, for a linear map; None: the most likely one is chosen for each frame.

    Raises
    ------
    ValueError
        A parameter that is not finite and above 0.
    """

    correlation_length_m: float = 1e-3
    tangential_ratio: float = 0.3
    std_pascal: float | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not 0.0 < value < np.inf:
                raise ValueError(f"{name} is {value}, must be finite and above 0")

    @property
    def powers(self) -> Floats:
        """Power of f_x, f_y and f_z over that of f_z, (3,)."""
        return np.array([self.tangential_ratio, self.tangential_ratio, 1.0])

    def spectrum_m2(self, omega_squared: Floats) -> Floats:
        """Return the power spectrum of an f_z of unit variance, of squared spatial frequencies in (rad/m)^2."""
        power = 4.0 * np.pi * self.correlation_length_m**2
        return np.asarray(power / (1.0 + omega_squared * self.correlation_length_m**2) ** 2, np.float64)


DEFAULT_PRIOR = Prior()
