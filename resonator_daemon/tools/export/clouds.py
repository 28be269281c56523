"""Messages as clouds of points in the plate's plane, which viewers show in colours of any of their fields."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.mqtt.payloads import Decoded, Forces, Message, Signals
from resonator_daemon.mqtt.units import AXES, with_axis

Points = NDArray[np.void]
"""Structured, (n,): x, y and z in metres as float32, and values named with their units; z points into the plate."""

_OF_FORCES: Final = ("force_newton", "noise_newton", "systematic_newton", "unobserved_bound_newton")
_OF_SIGNALS: Final = ("p_n", "eps_xz", "eps_yz")  # the rows of `signals`


class Clouds:
    """Translation of one plate's messages to point clouds.

    Parameters
    ----------
    site_ids
        Numbers of the sites, (n,).
    site_positions_m
        x and y of each in metres, (n, 2).
    """

    def __init__(self, site_ids: Iterable[int], site_positions_m: NDArray[np.float64]) -> None:
        self._positions_m = site_positions_m
        self._row_of_site = {int(site): row for row, site in enumerate(site_ids)}

    def fits(self, message: Message) -> bool:
        """Return whether a message is of these sites, and not of a plate that had the name before or has it now."""
        match message:
            case Forces():
                return all(force.site in self._row_of_site for force in message.sites)
            case Signals():
                return len(message.signals[0]) == len(self._positions_m)
            case Decoded():
                return on_grid(message) or len(message.traction_pascal[0]) == len(self._positions_m)
        return True

    def points(self, message: Message) -> Points | None:
        """Return the cloud of a message: of forces those sites on which something presses; None of kinds without."""
        match message:
            case Forces():
                return self._forces(message)
            case Signals():
                rows = {
                    f"{prefix}{name}{suffix}": values
                    for prefix, suffix, array in (("", "", message.signals), ("", "_std", message.noise_std))
                    for name, values in zip(_OF_SIGNALS, array, strict=True)
                }
                return _cloud(self._positions_m, rows)
            case Decoded():
                return self._decoded(message)
        return None

    def sites(self) -> Points:
        """Return the cloud of all sites, each with its number."""
        return _cloud(self._positions_m, {"site": np.array([*self._row_of_site], "<u2")})

    def _forces(self, message: Forces) -> Points:
        rows = [self._row_of_site[force.site] for force in message.sites]
        values: dict[str, Any] = {"site": np.array([force.site for force in message.sites], "<u2")}
        for key in _OF_FORCES:
            values[key] = np.array([getattr(force, key) for force in message.sites], "<f8")
        return _cloud(self._positions_m[rows], values)

    def _decoded(self, message: Decoded) -> Points:
        values = map_values(message)
        if message.grid is None or not on_grid(message):  # a map of few sites has its values there
            return _cloud(self._positions_m, values)
        ny, nx = message.traction_pascal.shape[1:]
        (x, y), pitch = message.grid.origin_m, message.grid.pitch_m
        places = np.meshgrid(x + pitch * np.arange(nx), y + pitch * np.arange(ny))
        return _cloud(np.stack([place.ravel() for place in places], 1), values)


def on_grid(message: Decoded) -> bool:
    """Return whether a map has pixels; else its values are those of the sites."""
    return message.grid is not None and message.traction_pascal.ndim == 3


def map_values(message: Decoded) -> dict[str, NDArray[Any]]:
    """Return the components of a map's arrays by name, each (n,), row by row."""
    values: dict[str, NDArray[Any]] = {}
    for key in ("traction_pascal", "traction_std_pascal", "displacement_m"):
        array = getattr(message, key)
        if array is not None:
            values |= {with_axis(key, axis): part.ravel() for axis, part in zip(AXES, array, strict=True)}
    return values


def packed(values: Mapping[str, NDArray[Any]], count: int) -> Points:
    """Return values side by side, (count,), structured."""
    points: Points = np.zeros(count, [(name, array.dtype.str) for name, array in values.items()])
    for name, array in values.items():
        points[name] = array
    return points


def _cloud(positions_m: NDArray[np.float64], values: dict[str, NDArray[Any]]) -> Points:
    x, y = positions_m.T.astype("<f4")
    return packed({"x": x, "y": y, "z": np.zeros_like(x)} | values, len(positions_m))
