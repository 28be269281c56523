"""Elastic half-space in the domain of spatial frequency: transfer matrices, fields, contact with friction."""

from resonator_daemon.estimate.elastic.constrained import NotConvergedError
from resonator_daemon.estimate.elastic.contact import FrictionalContact, flat_punch, paraboloid
from resonator_daemon.estimate.elastic.fields import SurfaceFields
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance
from resonator_daemon.estimate.elastic.mixed import MixedBoundary, solve_regions

__all__ = [
    "FrictionalContact",
    "HalfSpace",
    "MixedBoundary",
    "NotConvergedError",
    "SpectralGrid",
    "SurfaceCompliance",
    "SurfaceFields",
    "flat_punch",
    "paraboloid",
    "solve_regions",
]
