"""Latch of an overload until its end is certain."""

from dataclasses import replace

from resonator_daemon.estimate.forces.site_identification import Match


class OverloadLatch:
    """Latch that holds an overload until the pilot returns or its sites are within their range.

    A force that grows past the range moves the tone onto the next site's code, where it would look like a light touch.
    """

    def __init__(self) -> None:
        self._held: Match | None = None

    def release(self) -> None:
        """Release the overload: the pilot has returned."""
        self._held = None

    def apply(self, match: Match) -> Match:
        """Return `match`, or the held overload if `match` does not name its sites."""
        if self._held and not {force.site for force in self._held.forces} <= {force.site for force in match.forces}:
            return self._held
        overloaded = tuple(force for force in match.forces if force.status == "overload")
        # Forces of other sites are those of this reading alone.
        self._held = replace(match, forces=overloaded) if overloaded else None
        return match
