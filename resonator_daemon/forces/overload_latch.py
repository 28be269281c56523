"""Overload that lasts until it is known to be over, whatever its tone looks like meanwhile."""

from dataclasses import replace

from resonator_daemon.forces.site_identification import Match


class OverloadLatch:
    """Holds an overload until the pilot is heard again or its sites are heard within their range.

    A force that grows past the range moves the tone onto the next site's code, where it would look like a light touch.
    """

    def __init__(self) -> None:
        self._held: Match | None = None

    def release(self) -> None:
        """Let go: the pilot is heard, nothing presses."""
        self._held = None

    def apply(self, match: Match) -> Match:
        """Return `match`, or the overload that is held where `match` does not name its sites."""
        if self._held and not {force.site for force in self._held.forces} <= {force.site for force in match.forces}:
            return self._held
        overloaded = tuple(force for force in match.forces if force.status == "overload")
        # Forces of other sites are those of this reading alone.
        self._held = replace(match, forces=overloaded) if overloaded else None
        return match
