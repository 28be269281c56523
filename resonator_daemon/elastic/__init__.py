"""Linear elasticity of a half-space in the domain of spatial frequency: pure arrays, no I/O."""

from resonator_daemon.elastic.fields import SurfaceFields
from resonator_daemon.elastic.grid import SpectralGrid
from resonator_daemon.elastic.half_space import Convention, HalfSpace

__all__ = ["Convention", "HalfSpace", "SpectralGrid", "SurfaceFields"]
