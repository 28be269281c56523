"""Skin and options of its decoder."""

from dataclasses import dataclass
from typing import Literal

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.prior import DEFAULT_PRIOR, Prior
from resonator_daemon.elastic import HalfSpace


@dataclass(frozen=True, eq=False)
class Skin:
    """Sites under an elastic half-space, with the prior of its loads."""

    half_space: HalfSpace
    site_positions_m: Floats  # (n, 2); those of a grid row by row, x running first
    depth_m: float
    gain_std: float = 0.0
    prior: Prior = DEFAULT_PRIOR

    def geometry(self) -> tuple[object, ...]:
        """Return what two skins have in common that one decoder serves."""
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
