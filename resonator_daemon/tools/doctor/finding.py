"""Findings of the doctor: each check as a row, what it found, and the report of all findings with its verdict."""

import json
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, NamedTuple, TextIO

from resonator_daemon.base.host.text import Colour, coloured, printable, with_pages


class Outcome(StrEnum):
    """How a check ended, the worst last."""

    NOT_CHECKED = "not_checked"
    OK = "ok"
    WARNING = "warning"
    FAULT = "fault"


class Area(StrEnum):
    """Who must act."""

    WIRING = "wiring"
    SENSOR = "sensor"
    SOFTWARE = "software"


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

    @property
    def bad(self) -> bool:
        """Whether something is wrong."""
        return self.outcome in (Outcome.WARNING, Outcome.FAULT)

    def __str__(self) -> str:
        return f"{self.id} ({self.title}): {self.evidence}"


@dataclass(frozen=True, slots=True)
class Check:
    """Row of the table of checks; `id` stays the same from version to version.

    Attributes
    ----------
    remedy
        What to do, where a finding has no remedy of its own.
    unit, warning_above, fault_above
        Of a value of which less is better. An amount that is a plain number has this unit and the first limit above 0.
    """

    id: str
    area: Area
    title: str
    remedy: str = ""
    unit: str = ""
    warning_above: float | None = None
    fault_above: float | None = None

    def ok(self, evidence: str, amount: Amount | float | None = None) -> Finding:
        return self._finding(Outcome.OK, evidence, "", amount)

    def warning(self, evidence: str, remedy: str = "", amount: Amount | float | None = None) -> Finding:
        return self._finding(Outcome.WARNING, evidence, remedy or self.remedy, amount)

    def fault(self, evidence: str, remedy: str = "", amount: Amount | float | None = None) -> Finding:
        return self._finding(Outcome.FAULT, evidence, remedy or self.remedy, amount)

    def not_checked(self, reason: str) -> Finding:
        return self._finding(Outcome.NOT_CHECKED, reason, "", None)

    def judged(self, value: float, evidence: str, *, remedy: str = "", amount: Amount | float | None = None) -> Finding:
        """Return the finding on a value by the limits of this check; `amount` replaces the value in the report."""
        shown = value if amount is None else amount
        if self.fault_above is not None and value > self.fault_above:
            return self.fault(evidence, remedy, shown)
        if self.warning_above is not None and value > self.warning_above:
            return self.warning(evidence, remedy, shown)
        return self.ok(evidence, shown)

    def _finding(self, outcome: Outcome, evidence: str, remedy: str, amount: Amount | float | None) -> Finding:
        if isinstance(amount, int | float):
            amount = Amount(float(amount), self.warning_above or self.fault_above, self.unit)
        return Finding(self.id, self.area, self.title, outcome, evidence, remedy, *(amount or Amount(None)))


_WORDS: Final = json.loads(Path(__file__).with_name("checks.json").read_text(encoding="utf-8"))


def make_check(
    check_id: str, unit: str = "", *, warning_above: float | None = None, fault_above: float | None = None
) -> Check:
    """Return a check whose area, title and remedy are in `checks.json`."""
    words = _WORDS["checks"][check_id]
    return Check(check_id, Area(words["area"]), words["title"], _remedy(words), unit, warning_above, fault_above)


def _remedy(words: Mapping[str, str]) -> str:
    """Return the remedy of an entry: its own, or that of another check."""
    source = _WORDS["checks"][words["remedy_of"]] if "remedy_of" in words else words
    return with_pages(source.get("remedy", ""))


STATE_REMEDIES: Final[Mapping[Any, str]] = {code: _remedy(words) for code, words in _WORDS["sensor_states"].items()}
"""Remedy for a state of the sensor, by the word of its condition or its reason."""


def downgraded(finding: Finding, excuse: str) -> Finding:
    """Return that it could not be checked, where something else than what it names explains what was seen."""
    if not excuse or not finding.bad:
        return finding
    evidence = f"{excuse}; seen: {finding.evidence}"
    return Finding(finding.id, finding.area, finding.title, Outcome.NOT_CHECKED, evidence)


def not_checked(checks: Iterable[Check], reason: str) -> list[Finding]:
    """Return a finding for each of these: it could not be checked."""
    return [check.not_checked(reason) for check in checks]


_ASKED: Final = "sensor.load"  # whose result is wanted, whatever it is
FINE: Final = "fine"  # the verdict without a fault
WIDTH: Final = 80
_MARKS: Final = {Outcome.OK: "ok", Outcome.WARNING: "WARNING", Outcome.FAULT: "FAULT"}
_MARK_WIDTH: Final = 9
_OUTCOME: Final = re.compile(r"(?<=^  )(ok|WARNING|FAULT)|(?<=^verdict: )\w+", re.MULTILINE)
_COLOURS: Final[Mapping[str, Colour]] = {"ok": "green", FINE: "green", "WARNING": "yellow"}  # others red


class Report:
    """All findings, in the order of causes; those of one stage in the order of the checks."""

    def __init__(self, findings: Iterable[Finding]) -> None:
        self.findings = sorted(findings, key=lambda finding: list(Stage).index(finding.stage))

    @property
    def faulty(self) -> tuple[Area, ...]:
        """Areas with a fault, the first cause first."""
        faults = (finding.area for finding in self.findings if finding.outcome is Outcome.FAULT)
        return tuple(dict.fromkeys(faults))

    @property
    def verdict(self) -> str:
        """`wiring`, `sensor`, `software` or `fine`: who must act first."""
        return self.faulty[0].value if self.faulty else FINE

    @property
    def cause(self) -> Finding | None:
        """The first fault: what explains the others, where anything does."""
        return next((finding for finding in self.findings if finding.outcome is Outcome.FAULT), None)

    @property
    def verdict_text(self) -> str:
        """The verdict in words, with the first fault, or the number of warnings and the first."""
        if self.cause is None:
            bad = [finding for finding in self.findings if finding.bad]
            return f"{self.verdict}, with {_number(len(bad), 'warning')}; first: {bad[0]}" if bad else self.verdict
        others = "".join(f", then {area.value}" for area in self.faulty[1:])
        return f"{self.verdict}{others}; first: {self.cause}"

    def as_json(self) -> dict[str, Any]:
        return {
            "verb": "doctor",
            "ok": not self.faulty,
            "verdict": self.verdict,
            "faulty": list(self.faulty),
            "cause": self.cause.id if self.cause else None,
            "findings": [asdict(finding) for finding in self.findings],
        }

    def as_text(self, *, whole: bool = True, verbose: bool = True) -> str:
        """Return the lines of the text output; without a verdict where not everything was checked.

        Without `verbose`, a stage in which all is well is one line.
        """
        verdict = [*_wrapped("verdict: ", self.verdict_text)]
        lines = self._lines(verbose)
        return "\n".join([*verdict, "", *lines, self._counts(), *verdict] if whole else lines) + "\n"

    def write(self, stream: TextIO, *, whole: bool = True, verbose: bool = True) -> None:
        """Write the text output, on a terminal with the outcomes and the verdict in colour."""

        def paint(found: re.Match[str]) -> str:
            return coloured(found[0], _COLOURS.get(found[0], "red"), stream)

        stream.write(_OUTCOME.sub(paint, self.as_text(whole=whole, verbose=verbose)))

    def _lines(self, verbose: bool) -> Iterator[str]:
        for stage in Stage:
            own = [f for f in self.findings if f.stage is stage and f.outcome is not Outcome.NOT_CHECKED]
            if own and not verbose and not any(finding.bad or finding.id == _ASKED for finding in own):
                yield from (f"{stage.value}: {len(own)} ok", "")
                continue
            if own:
                yield stage.value
            for finding in own:
                yield from _wrapped(f"  {_MARKS[finding.outcome]:<{_MARK_WIDTH}}", str(finding))
                if finding.remedy:
                    yield from _wrapped(" " * (_MARK_WIDTH + 2), f"-> {finding.remedy}")
            if own:
                yield ""
        omitted: dict[str, list[str]] = {}
        for finding in self.findings:
            if finding.outcome is Outcome.NOT_CHECKED:
                omitted.setdefault(finding.evidence, []).append(finding.id)
        if omitted:
            yield "not checked"
        for reason, ids in omitted.items():
            yield from _wrapped(" " * (_MARK_WIDTH + 2), f"{reason}: {', '.join(ids)}")
        if omitted:
            yield ""

    def _counts(self) -> str:
        counts = Counter(finding.outcome for finding in self.findings)
        return (
            f"{_number(len(self.findings), 'check')}: {_number(counts[Outcome.FAULT], 'fault')}, "
            f"{_number(counts[Outcome.WARNING], 'warning')}, {counts[Outcome.OK]} ok, "
            f"{counts[Outcome.NOT_CHECKED]} not checked"
        )


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _wrapped(head: str, text: str) -> Iterable[str]:
    return textwrap.wrap(
        printable(" ".join(text.split())),
        WIDTH,
        initial_indent=head,
        subsequent_indent=" " * len(head),
        break_long_words=False,
        break_on_hyphens=False,
    )
