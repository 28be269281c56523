"""The verdict over all findings, and the report of it: as text in 80 columns, or as one JSON object."""

import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from typing import Any, Final, TextIO

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.base.host.text import Colour, coloured, printable
from resonator_daemon.tools.doctor.finding import FINE, Area, Finding, Outcome, Stage

WIDTH: Final = 80
_MARKS: Final = {Outcome.OK: "ok", Outcome.WARNING: "WARNING", Outcome.FAULT: "FAULT", Outcome.NOT_CHECKED: "-"}
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
    def exit_code(self) -> ExitCode:
        return ExitCode.FAILED if self.faulty else ExitCode.DONE

    @property
    def verdict_text(self) -> str:
        """The verdict in words, with the first fault."""
        if self.cause is None:
            return self.verdict
        others = "".join(f", then {area.value}" for area in self.faulty[1:])
        return f"{self.verdict}{others}; first: {_named(self.cause)}"

    def count(self, outcome: Outcome) -> int:
        return sum(finding.outcome is outcome for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        return {
            "verb": "doctor",
            "ok": not self.faulty,
            "verdict": self.verdict,
            "faulty": list(self.faulty),
            "cause": self.cause.id if self.cause else None,
            "findings": [asdict(finding) for finding in self.findings],
        }

    def as_text(self, *, whole: bool = True) -> str:
        """Return the lines of the text output; without a verdict where not everything was checked."""
        lines = [line for stage in Stage for line in self._lines_of(stage)]
        ending = self._ending() if whole else ()
        return "\n".join([*lines, *self._not_checked_together(), *ending]) + "\n"

    def write(self, stream: TextIO, *, whole: bool = True) -> None:
        """Write the text output, on a terminal with the outcomes and the verdict in colour."""

        def paint(found: re.Match[str]) -> str:
            return coloured(found[0], _COLOURS.get(found[0], "red"), stream)

        stream.write(_OUTCOME.sub(paint, self.as_text(whole=whole)))

    @property
    def _omitted(self) -> dict[str, list[Finding]]:
        """What was not checked, by the reason."""
        omitted: dict[str, list[Finding]] = {}
        for finding in self.findings:
            if finding.outcome is Outcome.NOT_CHECKED:
                omitted.setdefault(finding.evidence, []).append(finding)
        return omitted

    @property
    def _shared_reasons(self) -> dict[str, list[str]]:
        """Why several things were not checked, each reason with the ids of these."""
        shared = {reason: findings for reason, findings in self._omitted.items() if len(findings) > 1}
        return {reason: [finding.id for finding in findings] for reason, findings in shared.items()}

    def _not_checked_together(self) -> Iterator[str]:
        """Yield the lines that hold for several findings."""
        shared = self._shared_reasons
        if not shared:
            return
        yield "not checked"
        for reason, ids in shared.items():
            yield from _wrapped(f"  {_MARKS[Outcome.NOT_CHECKED]:<{_MARK_WIDTH}}", f"{reason}: {', '.join(ids)}")
        yield ""

    def _lines_of(self, stage: Stage) -> Iterator[str]:
        together = self._shared_reasons
        of_stage = [
            finding
            for finding in self.findings
            if finding.stage is stage and not (finding.outcome is Outcome.NOT_CHECKED and finding.evidence in together)
        ]
        if not of_stage:
            return
        yield stage.value
        for finding in of_stage:
            yield from _wrapped(f"  {_MARKS[finding.outcome]:<{_MARK_WIDTH}}", _named(finding))
            if finding.remedy:
                yield from _wrapped(" " * (_MARK_WIDTH + 2), f"-> {finding.remedy}")
        yield ""

    def _ending(self) -> Iterator[str]:
        counts = ", ".join(
            f"{self.count(outcome)} {name}"
            for outcome, name in (
                (Outcome.FAULT, "faults"),
                (Outcome.WARNING, "warnings"),
                (Outcome.OK, "ok"),
                (Outcome.NOT_CHECKED, "not checked"),
            )
        )
        yield f"{len(self.findings)} checks: {counts}"
        for reason, omitted in self._omitted.items():
            stages = ", ".join(dict.fromkeys(finding.stage.value for finding in omitted))
            yield from _wrapped("not checked: ", f"{len(omitted)} of {stages}: {reason}")
        yield from _wrapped("verdict: ", self.verdict_text)


def _named(finding: Finding) -> str:
    return f"{finding.id} ({finding.title}): {finding.evidence}"


def _wrapped(head: str, text: str) -> Iterable[str]:
    return textwrap.wrap(
        printable(" ".join(text.split())),
        WIDTH,
        initial_indent=head,
        subsequent_indent=" " * len(head),
        break_long_words=False,
        break_on_hyphens=False,
    )
