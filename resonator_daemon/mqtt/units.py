"""Units of the payloads' keys: each is the ending of a key, so that `info` lists them all in one small table."""

from typing import Final

UNITS: Final[dict[str, str]] = {
    "ns": "ns",
    "ms": "ms",
    "s": "s",
    "hz": "Hz",
    "m": "m",
    "m2": "m2",
    "newton": "N",
    "newton_m": "N.m",
    "pascal": "Pa",
    "kelvin": "K",
    "percent": "%",
    "ppm": "[ppm]",
    "bytes": "By",
    "mb": "MBy",
    "ticks": "{tick}",
}
"""Unit by the ending of a key, in the notation of UCUM; a tick is one of the board's clock."""

DIMENSIONLESS: Final = frozenset(
    {
        "chi2",
        "common_mode",
        "friction_coefficient",
        "gain",
        "model_error",
        "noise",
        "poisson_ratio",
        "position_correlation",
        "residual",
        "sensitivity",
        "signals",
        "slip_margin",
        "stick_ratio",
        "tangential_ratio",
    }
)
"""Keys of numbers without a unit, without the `_std` that a standard deviation has at its end."""

NO_UNIT: Final = "1"
AXES: Final = "xyz"


def unit_of(key: str) -> str | None:
    """Return the unit of a key's numbers: that of the longest ending in `UNITS`, `_std` left off; None for others."""
    bare = key.removesuffix("_std")
    if bare in DIMENSIONLESS:
        return NO_UNIT
    parts = bare.split("_")
    endings = ("_".join(parts[start:]) for start in range(1, len(parts)))
    return next((UNITS[ending] for ending in endings if ending in UNITS), None)


def with_axis(name: str, axis: str) -> str:
    """Return the name of a vector's component: its letter before the unit, as `force_x_newton`."""
    parts = name.split("_")
    for start in range(1, len(parts)):
        if "_".join(parts[start:]) in UNITS:
            return "_".join((*parts[:start], axis, *parts[start:]))
    return f"{name}_{axis}"
