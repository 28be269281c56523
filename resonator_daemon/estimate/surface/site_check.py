"""Which sites of a skin fail: their signals differ from what all others predict, in one check after the other."""

from typing import Final

import numpy as np

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder

_LIMIT: Final = 6.5  # standard deviations between a signal and its prediction
_FAULT: Final = 0.2  # of a signal: a site under load that would show so much, and does not, is sound
_SUSPECT_CHECKS: Final = 2  # in which a site must have failed ...
_EXCLUDED_CHECKS: Final = 20  # ... and from which on its signals count as lost
_SITES_MAX: Final = 4  # where more differ, it is not single sites that are wrong


class SiteCheck:
    """Monitor of the sites of one skin, by frames in which something presses it.

    Only a load shows whether a site is sound. A site that failed remains suspect until a load shows that it is.

    Attributes
    ----------
    failed
        Number of checks in which sites failed, by index.
    """

    def __init__(self, decoder: OpenPlaneDecoder) -> None:
        self._decoder = decoder
        self.failed: dict[int, int] = {}

    @property
    def suspects(self) -> tuple[int, ...]:
        """Indices of the sites that fail."""
        return tuple(sorted(site for site, checks in self.failed.items() if checks >= _SUSPECT_CHECKS))

    @property
    def excluded(self) -> list[int]:
        """Indices of the suspects that have failed for so long that they are not to be used."""
        return [site for site, checks in self.failed.items() if checks >= _EXCLUDED_CHECKS]

    def check(self, signals: Floats) -> None:
        """Check a frame (3, n), lost signals NaN, with the excluded sites."""
        found, shown = self._differing(signals.copy())
        for site in found:
            self.failed[site] = self.failed.get(site, 0) + 1
        for site in [site for site in self.failed if shown[site] and site not in found]:
            del self.failed[site]

    def _differing(self, frame: Floats) -> tuple[list[int], Bools]:
        """Return sites that differ, the worst first, each without those before it, and which would show a fault."""
        found: list[int] = []
        while True:
            scores, expected = self._decoder.expected(frame)
            of_sites = np.nan_to_num(np.abs(scores)).max(axis=0)
            worst = int(of_sites.argmax())
            if of_sites[worst] <= _LIMIT:
                return found, np.abs(expected).max(axis=0) > _LIMIT / _FAULT
            if len(found) == _SITES_MAX:
                return [], np.zeros(of_sites.size, np.bool_)
            found.append(worst)
            frame[:, worst] = np.nan
