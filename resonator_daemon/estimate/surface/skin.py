"""Skin, the prior of the traction on it, and options of its decoder."""

from dataclasses import KW_ONLY, dataclass
from typing import Final, Literal

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.layout import as_grid, diagonal_m, gap_m, refuse_duplicates

# With fewer sites, or others further apart, a map peaks at the nearest site and shows almost nothing in between.
_SITES_MIN: Final = 40
_WIDEST_SPACING_DEPTHS: Final = 3.0


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


@dataclass(frozen=True, eq=False)
class Skin:
    """Sites under an elastic half-space, with the prior of its loads, and standard deviations of what it states."""

    half_space: HalfSpace
    site_positions_m: Floats  # (n, 2); those of a grid row by row, x running first
    depth_m: float
    gain_std: float = 0.0  # of each signal by itself
    prior: Prior = DEFAULT_PRIOR
    _: KW_ONLY
    depth_std_m: float = 0.0
    modulus_std_pascal: float = 0.0
    gain_std_common: float = 0.0  # of all signals together
    position_std_m: float = 0.0  # of each site, in x and in y

    @property
    def modulus_std(self) -> float:
        """Relative standard deviation of Young's modulus."""
        return self.modulus_std_pascal / self.half_space.youngs_modulus_pascal

    def geometry(self) -> tuple[object, ...]:
        """Return a key; one decoder serves all skins with equal keys."""
        elastic = (self.half_space.youngs_modulus_pascal, self.half_space.poisson_ratio, self.depth_m)
        return (self.site_positions_m.tobytes(), *elastic, self.gain_std, self.prior)


@dataclass(frozen=True)
class DecodingOptions:
    """Options of a decoder; contact physics needs the method "open-plane"."""

    method: Literal["open-plane", "fourier"] = "open-plane"
    contact_physics: bool = True
    friction_coefficient: float | None = None  # None: not known
    displacement: bool = True  # of the surface, too
    background: bool = True  # contact physics prepares its matrices in another thread; False: while it decodes


def refuse_undecodable(skin: Skin, options: DecodingOptions) -> None:
    """Raise ValueError for sites or a method that `SkinDecoder` would refuse; faster than setting it up."""
    sites_m = skin.site_positions_m
    depths_m = np.full(len(sites_m), skin.depth_m)
    if len(sites_m) < _SITES_MIN:
        raise ValueError(f"{len(sites_m)} sites under a skin; at least {_SITES_MIN} are needed for a map")
    refuse_duplicates(sites_m, depths_m)
    diagonal_m(sites_m, depths_m)
    spacing_m, widest_m = gap_m(sites_m), _WIDEST_SPACING_DEPTHS * skin.depth_m
    if spacing_m > widest_m:
        raise ValueError(
            f"sites are {1e3 * spacing_m:.3g} mm apart; at a depth of {1e3 * skin.depth_m:.3g} mm a map needs "
            f"at most {1e3 * widest_m:.3g} mm"
        )
    grid = as_grid(sites_m)
    if options.method == "fourier" and (grid is None or not np.isclose(grid.pitch_x_m, grid.pitch_y_m)):
        raise ValueError(
            f'method "fourier" needs a square grid of at least 2 x 2 sites; these {len(sites_m)} form none; '
            'use "open-plane"'
        )
