"""`resonatord replay --check`: cases replayed and compared with what they expect."""

import json
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

from resonator_daemon.errors import ConfigurationError, DifferenceError, ExitCode, InterruptedCommandError
from resonator_daemon.host.printable import printable
from resonator_daemon.host.signals import interruptible
from resonator_daemon.links.link import LinkUnavailableError
from resonator_daemon.publishing.topics import DECODED
from resonator_daemon.replay.case import RECORDING_FILE, Expected, Outcome, read_expected, replay_whole
from resonator_daemon.replay.source import open_replay

_SHOWN_MAX: Final = 5  # differences of a case; the rest is counted
_VALUE_LENGTH: Final = 60

TOLERANCE: Final = 1e-6  # of the largest value that its field has in the case
# What is decoded is worked out in single precision, and rounds otherwise where arrays lie otherwise in memory.
DECODED_TOLERANCE: Final = 1e-3


class Difference(NamedTuple):
    """A key and its two values."""

    key: str
    expected: object
    got: object


ABSENT: Final = "nothing"

_NOT_COMPARED: Final = {"info": ("daemon_version", "commands")}  # of another version the same is expected


class Scales:
    """The largest magnitude of each field of floats, over all messages of a topic; elements of a list are one field."""

    def __init__(self, tolerance: float = TOLERANCE) -> None:
        self._tolerance = tolerance
        self._largest: dict[str, float] = {}

    def add(self, topic: str, payload: Any) -> None:
        for field, value in _floats(topic, payload):
            self._largest[field] = max(self._largest.get(field, 0.0), abs(value))

    def tolerance(self, field: str) -> float:
        return self._tolerance * self._largest.get(field, 0.0)


def payload_differences(topic: str, expected: Any, got: Any, scales: Scales) -> Iterator[Difference]:
    """Give each key of a message that differs."""
    for key in _NOT_COMPARED.get(topic, ()):
        expected = {name: value for name, value in expected.items() if name != key}
        got = {name: value for name, value in got.items() if name != key}
    yield from _differences("", topic, expected, got, scales)


def _differences(key: str, field: str, expected: Any, got: Any, scales: Scales) -> Iterator[Difference]:
    if type(expected) is not type(got):
        yield Difference(key, expected, got)
    elif isinstance(expected, dict):
        for name in dict.fromkeys((*expected, *got)):
            inner = f"{key}.{name}" if key else str(name)
            if name not in got or name not in expected:
                yield Difference(inner, expected.get(name, ABSENT), got.get(name, ABSENT))
            else:
                yield from _differences(inner, f"{field}.{name}", expected[name], got[name], scales)
    elif isinstance(expected, list):
        if len(expected) != len(got):
            yield Difference(f"{key}[]", f"{len(expected)} elements", f"{len(got)} elements")
        for number, (one, other) in enumerate(zip(expected, got, strict=False)):
            yield from _differences(f"{key}[{number}]", f"{field}[]", one, other, scales)
    elif isinstance(expected, float):
        if not math.isclose(expected, got, rel_tol=0.0, abs_tol=scales.tolerance(field)):
            yield Difference(key, expected, got)
    elif expected != got:
        yield Difference(key, expected, got)


def _floats(field: str, value: Any) -> Iterable[tuple[str, float]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _floats(f"{field}.{name}", inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _floats(f"{field}[]", inner)
    elif isinstance(value, float) and math.isfinite(value):
        yield field, value


@dataclass(frozen=True)
class Finding:
    """Where a replay differs from what is expected: where, when after the first message, and in what."""

    topic: str
    at_s: float | None
    difference: Difference

    def __str__(self) -> str:
        key, expected, got = self.difference
        when = "" if self.at_s is None else f" at {self.at_s:.3f} s"
        return f"{self.topic}{when}: {key}: expected {_short(expected)}, got {_short(got)}"


@dataclass(frozen=True)
class Verdict:
    """What came of one case; `messages`: those compared; `to_the_bit`: all are equal, those that are not kept, too."""

    case: str
    messages: int
    to_the_bit: bool
    differences: int
    first: tuple[Finding, ...]

    def as_json(self) -> dict[str, Any]:
        return {
            "case": self.case,
            "ok": not self.differences,
            "messages": self.messages,
            "to_the_bit": self.to_the_bit,
            "differences": self.differences,
            "first": [
                {"topic": finding.topic, "at_s": finding.at_s, **finding.difference._asdict()} for finding in self.first
            ],
        }


def check_cases(directories: Sequence[Path], *, as_json: bool) -> ExitCode:
    """Check cases and print what came of each.

    Raises
    ------
    ConfigurationError
        What is named is no case, or what it expects cannot be read.
    InterruptedCommandError
        Ctrl-C came before the last one was checked.
    DifferenceError
        A case has other messages than it expects.
    """
    verdicts: list[Verdict] = []
    try:
        expected = {directory: read_expected(directory) for directory in directories}
        with interruptible(""):
            for directory, case in expected.items():
                verdict = check_case(directory, case)
                verdicts.append(verdict)
                if not as_json:
                    sys.stdout.write(_text(verdict))
    except InterruptedCommandError:
        words = f"{len(verdicts)} of {len(set(directories))} fixtures checked, {_bad(verdicts)} differ"
        so_far = {"cases": [verdict.as_json() for verdict in verdicts]}
        raise InterruptedCommandError(f"interrupted: {words}", so_far=so_far) from None
    bad, cases = _bad(verdicts), [verdict.as_json() for verdict in verdicts]
    counts = f"{len(verdicts)} fixtures, {bad} differ"
    if bad:
        raise DifferenceError(counts, so_far={"cases": cases})
    if as_json:
        sys.stdout.write(json.dumps({"verb": "replay", "ok": True, "cases": cases}) + "\n")
    else:
        sys.stderr.write(f"{counts}\n")
    return ExitCode.DONE


def _bad(verdicts: Sequence[Verdict]) -> int:
    return sum(1 for verdict in verdicts if verdict.differences)


def check_case(directory: Path, expected: Expected) -> Verdict:
    """Replay a fixture and compare; a recording that cannot be replayed any more is a difference."""
    try:
        with open_replay(directory / RECORDING_FILE) as replaying:
            outcome = replay_whole(replaying, expected.every)
    except (LinkUnavailableError, ConfigurationError) as error:
        finding = Finding("recording", None, Difference("replay", "possible", str(error)))
        return Verdict(directory.name, 0, to_the_bit=False, differences=1, first=(finding,))
    findings = _findings(expected, outcome)
    return Verdict(
        directory.name,
        len(expected.messages),
        expected.sha256 == outcome.sha256,
        len(findings),
        tuple(findings[:_SHOWN_MAX]),
    )


def _findings(expected: Expected, outcome: Outcome) -> list[Finding]:
    decoded = any(message.topic == DECODED.path for message in expected.messages)
    scales = Scales(DECODED_TOLERANCE if decoded else TOLERANCE)
    for message in expected.messages:
        scales.add(message.topic, message.payload)
    kept = {(message.topic, message.number): message for message in outcome.kept}
    findings = []
    for message in expected.messages:
        now_ns = int(message.now_ns)
        replayed = kept.pop((message.topic, message.number), None)
        if replayed is None:
            differences = [Difference(f"message {message.number}", "one", ABSENT)]
        else:
            differences = [Difference("(made)", now_ns, replayed.now_ns)] if replayed.now_ns != now_ns else []
            payload = json.loads(replayed.payload)
            differences += payload_differences(message.topic, message.payload, payload, scales)
        at_s = (now_ns - outcome.begun_ns) * 1e-9
        findings += [Finding(message.topic, at_s, difference) for difference in differences]
    for replayed in kept.values():
        at_s = (replayed.now_ns - outcome.begun_ns) * 1e-9
        findings.append(Finding(replayed.topic, at_s, Difference(f"message {replayed.number}", ABSENT, "one")))
    summary = (
        Finding("summary", None, found) for found in _differences("", "", expected.summary, outcome.summary, Scales())
    )
    return list(chain(findings, summary))


def _text(verdict: Verdict) -> str:
    if not verdict.differences:
        how = "to the bit" if verdict.to_the_bit else "within rounding"
        return f"ok      {verdict.case}: {verdict.messages} messages compared, equal {how}\n"
    lines = [f"DIFFERS {verdict.case}: {verdict.differences} differences"]
    lines += [f"        {printable(str(finding))}" for finding in verdict.first]
    return "".join(f"{line}\n" for line in lines)


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= _VALUE_LENGTH else f"{text[:_VALUE_LENGTH]}..."
