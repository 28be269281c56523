"""Elastic half-space in the domain of spatial frequency: transfer matrices, fields, contact with friction."""

from resonator_daemon.estimate.elastic import (
    Convention,
    FrictionalContact,
    HalfSpace,
    MixedBoundary,
    NotConvergedError,
    SensorArray,
    SensorSet,
    SpectralGrid,
    SurfaceCompliance,
    SurfaceFields,
    flat_punch,
    paraboloid,
    press,
    relief,
    solve_regions,
    sphere,
)

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
    "flat_punch",
    "paraboloid",
    "press",
    "relief",
    "solve_regions",
    "sphere",
]
