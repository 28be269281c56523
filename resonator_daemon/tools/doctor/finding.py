"""Result of one check: its subject, the evidence with its limit, the outcome, and what to do."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple


class Outcome(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARNING = "warning"
    FAULT = "fault"
    NOT_CHECKED = "not_checked"


class Area(StrEnum):
    """Who must act."""

    WIRING = "wiring"
    SENSOR = "sensor"
    SOFTWARE = "software"


FINE = "fine"


class Stage(StrEnum):
    """Where a cause lies, in the order of causes: what is wrong in one explains what is seen in the next."""

    COMPUTER = "computer"
    BROKER = "broker"
    LINK = "link"
    BOARD = "board"
    SENSOR = "sensor"
    CALIBRATION = "calibration"
    DISK = "disk"


_STAGES: Final = {  # by id, or by its part before the dot
    "broker": Stage.BROKER,
    "daemon.broker": Stage.BROKER,
    "port": Stage.LINK,
    "usb": Stage.LINK,
    "link": Stage.LINK,
    "host": Stage.LINK,
    "daemon.link": Stage.LINK,
    "board": Stage.BOARD,
    "sensor": Stage.SENSOR,
    "daemon.sensor": Stage.SENSOR,
    "sensor.calibration": Stage.CALIBRATION,
    "disk": Stage.DISK,
}


class Amount(NamedTuple):
    """Evidence as a number, with the limit that it is held against."""

    value: float | None
    limit: float | None = None
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a check.

    Attributes
    ----------
    evidence
        What was seen and what the limit is; of what was not checked, why not.
    value, limit, unit
        The same as numbers, where they are numbers.
    remedy
        What to do; empty where there is nothing to do.
    """

    id: str
    area: Area
    title: str
    outcome: Outcome
    evidence: str
    remedy: str = ""
    value: float | None = None
    limit: float | None = None
    unit: str = ""

    @property
    def stage(self) -> Stage:
        """Where the cause lies; `computer` for its clock, its service and the daemon."""
        return _STAGES.get(self.id) or _STAGES.get(self.id.partition(".")[0]) or Stage.COMPUTER


@dataclass(frozen=True, slots=True)
class Check:
    """Subject of a check; `id` stays the same from version to version."""

    id: str
    area: Area
    title: str

    def ok(self, evidence: str, amount: Amount | None = None) -> Finding:
        return self.judged(Outcome.OK, evidence, "", amount)

    def warning(self, evidence: str, remedy: str, amount: Amount | None = None) -> Finding:
        return self.judged(Outcome.WARNING, evidence, remedy, amount)

    def fault(self, evidence: str, remedy: str, amount: Amount | None = None) -> Finding:
        return self.judged(Outcome.FAULT, evidence, remedy, amount)

    def not_checked(self, reason: str) -> Finding:
        return self.judged(Outcome.NOT_CHECKED, reason, "")

    def judged(self, outcome: Outcome, evidence: str, remedy: str, amount: Amount | None = None) -> Finding:
        """Return a finding with an outcome that was weighed from numbers; a remedy belongs to what is not ok."""
        remedy = "" if outcome is Outcome.OK else remedy
        return Finding(self.id, self.area, self.title, outcome, evidence, remedy, *(amount or Amount(None)))


def excused(finding: Finding, excuse: str) -> Finding:
    """Return that it could not be checked, where something else than what it names explains what was seen."""
    if not excuse or finding.outcome not in (Outcome.WARNING, Outcome.FAULT):
        return finding
    return Finding(finding.id, finding.area, finding.title, Outcome.NOT_CHECKED, f"{excuse}; seen: {finding.evidence}")


def graded(value: float, warning_above: float, fault_above: float) -> Outcome:
    """Return how bad a value is of which less is better."""
    if value > fault_above:
        return Outcome.FAULT
    return Outcome.WARNING if value > warning_above else Outcome.OK


def not_checked(checks: Iterable[Check], reason: str) -> list[Finding]:
    """Return a finding for each of these: it could not be checked."""
    return [check.not_checked(reason) for check in checks]
