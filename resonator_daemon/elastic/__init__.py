"""Linear elasticity of a half-space in the domain of spatial frequency: pure arrays, no I/O."""

from resonator_daemon.elastic.constrained import NotConvergedError
from resonator_daemon.elastic.contact import press
from resonator_daemon.elastic.fields import SurfaceFields
from resonator_daemon.elastic.friction import FrictionalContact
from resonator_daemon.elastic.grid import SpectralGrid
from resonator_daemon.elastic.half_space import Convention, HalfSpace
from resonator_daemon.elastic.influence import SurfaceCompliance
from resonator_daemon.elastic.mixed import MixedBoundary
from resonator_daemon.elastic.regions import solve_regions
from resonator_daemon.elastic.sensor_resolution import SensorArray
from resonator_daemon.elastic.sensor_sets import SensorSet

__all__ = [
    "Convention",
    "FrictionalContact",
    "HalfSpace",
    "MixedBoundary",
    "NotConvergedError",
    "SensorArray",
    "SensorSet",
    "SpectralGrid",
    "SurfaceCompliance",
    "SurfaceFields",
    "press",
    "solve_regions",
]
