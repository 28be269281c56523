"""Detection of faulty sites of a skin: their signals repeatedly differ from the prediction from all others."""

from collections.abc import Callable
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

    Only a load shows whether a site is sound. A suspect site remains so until a load shows that it is sound.

    Attributes
    ----------
    failed_checks
        Number of checks in which sites differed, by index.
    """

    def __init__(self, decoder: OpenPlaneDecoder) -> None:
        self._decoder = decoder
        self.failed_checks: dict[int, int] = {}

    @property
    def suspects(self) -> tuple[int, ...]:
        """Indices of the suspect sites."""
        return tuple(sorted(site for site, checks in self.failed_checks.items() if checks >= _SUSPECT_CHECKS))

    @property
    def excluded(self) -> list[int]:
        """Indices of the suspects that have failed for so long that they are not to be used."""
        return [site for site, checks in self.failed_checks.items() if checks >= _EXCLUDED_CHECKS]

    def check(self, signals: Floats, pause: Callable[[], None] = lambda: None) -> None:
        """Check a frame (3, n), lost signals NaN, with the excluded sites; `pause` is called before each site."""
        found, shown = self._differing(signals.copy(), pause)
        for site in found:
            self.failed_checks[site] = self.failed_checks.get(site, 0) + 1
        for site in [site for site in self.failed_checks if shown[site] and site not in found]:
            del self.failed_checks[site]

    def _differing(self, frame: Floats, pause: Callable[[], None]) -> tuple[list[int], Bools]:
        """Return sites that differ, the worst first, each without those before it, and which would show a fault."""
        found: list[int] = []
        while True:
            pause()
            scores, expected = self._decoder.scores_and_predictions(frame)
            of_sites = np.nan_to_num(np.abs(scores)).max(axis=0)
            worst = int(of_sites.argmax())
            if of_sites[worst] <= _LIMIT:
                shown = np.where(np.isnan(scores), 0.0, np.abs(expected))  # lost signals show nothing
                return found, shown.max(axis=0) > _LIMIT / _FAULT
            if len(found) == _SITES_MAX:
                return [], np.zeros(of_sites.size, np.bool_)
            found.append(worst)
            frame[:, worst] = np.nan
