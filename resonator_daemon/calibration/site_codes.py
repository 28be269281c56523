"""Codes of a plate's force sites, by site."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.arrays import Floats
from resonator_daemon.plate import Plate
from resonator_daemon.plate_tables import FORCE_SIGNAL


class SiteCodes(NamedTuple):
    """Codes of m force sites in the plate file, in the order of its site_ids."""

    tone: NDArray[np.intp]  # (m,), its place among the plate's tones
    f0_hz: Floats  # (m, 4)
    sensitivity: Floats  # (m, 4), 1/N
    temperature_coefficients: Floats  # (m, 3), NaN where the file does not give them


def site_codes(plate: Plate) -> SiteCodes:
    """Return the codes of a plate with force sites."""
    tones = plate.tones
    of_force = np.flatnonzero(tones.signal_index == plate.signals.index(FORCE_SIGNAL))
    tone = of_force[np.argsort(tones.site_index[of_force])]
    return SiteCodes(tone, tones.f0_hz[tone], tones.sensitivity[tone], tones.temperature_coefficients[tone])
