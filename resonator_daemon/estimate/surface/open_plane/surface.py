"""Surface of a frame out of its modes, and surfaces of many frames out of theirs."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from resonator_daemon.base.arrays import Bools, Floats, Indices, Singles
from resonator_daemon.estimate.surface.open_plane.modes import Modes

_SUPPORT_SHARE = 0.1  # of the peak of f_z: under a contact, or next to it
_BORDER_RATIO = 1.5  # over that, at the border: the load goes on beyond


@dataclass(frozen=True)
class Surface:
    """Surface of a frame, out of its modes."""

    modes: Modes
    amplitudes: Singles  # of the modes, (r,)
    declared_std: Floats  # posterior standard deviation of the traction at the declared noise, (3, m)
    excess: float  # factor of the standard deviation by noise beyond the declared one
    contact_factor: float  # further factor under a contact
    least_pressure: float  # that a contact may have
    border: Indices  # places at the border

    @cached_property
    def traction(self) -> Singles:
        """Traction, (3 m,)."""
        return self.modes.traction(self.amplitudes)

    @cached_property
    def pressure(self) -> Singles:
        """f_z, (m,)."""
        whole = self.__dict__.get("traction")
        return self.modes.pressure(self.amplitudes) if whole is None else whole[-whole.size // 3 :]

    @cached_property
    def displacement(self) -> Singles:
        """Displacement, (3 m,)."""
        return self.modes.displacement(self.amplitudes)

    def std(self) -> Floats:
        """Return the standard deviation of the traction, (3, m)."""
        under = self.pressure > self._threshold
        return self.declared_std * np.where(under, self.excess * self.contact_factor, self.excess)

    @cached_property
    def significance(self) -> float:
        """Largest pressure over its standard deviation."""
        highest = int(self.pressure.argmax())
        std = float(self.declared_std[2, highest]) * self.excess
        pressure = float(self.pressure[highest])
        return pressure / (std * self.contact_factor if pressure > self._threshold else std)

    @property
    def reaches_border(self) -> bool:
        """Whether the load goes on beyond the border."""
        at_border = float(self.pressure.take(self.border).max(initial=0.0))
        return at_border > _BORDER_RATIO * self._threshold

    @cached_property
    def _threshold(self) -> float:
        return max(_SUPPORT_SHARE * float(self.pressure.max()), self.least_pressure)


@dataclass(frozen=True)
class SurfaceStack:
    """Surfaces of k frames out of the same modes; what `Surface` has, with a leading axis."""

    modes: Modes
    amplitudes: Singles  # of the modes, (r, k)
    std_by_scale: Floats  # posterior standard deviation of the traction at the declared noise, (scales, 3 m)
    scale: Indices  # of each frame, (k,)
    excess: Floats  # (k,)
    contact_factor: float
    least_pressure: Floats  # (k,)
    border: Indices

    @cached_property
    def traction(self) -> Singles:
        """Traction, (k, 3 m)."""
        return self.modes.traction(self.amplitudes)

    def displacement(self) -> Singles:
        """Return the displacement, (k, 3 m)."""
        return self.modes.displacement(self.amplitudes)

    def std(self) -> Floats:
        """Return the standard deviation of the traction, (k, 3, m)."""
        is_under, excess = self._pressure > self._threshold[:, None], self.excess[:, None]
        factor = np.where(is_under, excess * self.contact_factor, excess)
        std = self.std_by_scale.take(self.scale, axis=0).reshape(len(factor), 3, -1)
        std *= factor[:, None]
        return std

    @property
    def reaches_border(self) -> Bools:
        """Whether the load of each frame goes on beyond the border, (k,)."""
        at_border = self._pressure[:, self.border].max(axis=1, initial=0.0)
        return np.asarray(at_border > _BORDER_RATIO * self._threshold, np.bool_)

    def separate(self, displacement: bool) -> Iterator[Surface]:
        """Yield the surface of each frame, its traction computed, and its displacement if asked for."""
        amplitudes, moved = np.ascontiguousarray(self.amplitudes.T), self.displacement() if displacement else None
        for number, scale in enumerate(self.scale):
            surface = Surface(
                self.modes,
                amplitudes[number],
                self.std_by_scale[scale].reshape(3, -1),
                float(self.excess[number]),
                self.contact_factor,
                float(self.least_pressure[number]),
                self.border,
            )
            vars(surface)["traction"] = self.traction[number]
            if moved is not None:
                vars(surface)["displacement"] = moved[number]
            yield surface

    @property
    def _pressure(self) -> Singles:
        return self.traction[:, -self.traction.shape[1] // 3 :]

    @cached_property
    def _threshold(self) -> Singles:
        highest = self._pressure.max(axis=1)
        return np.asarray(np.maximum(_SUPPORT_SHARE * highest, self.least_pressure), np.float32)
