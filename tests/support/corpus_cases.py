"""Cases of tests/corpus: a recording, the messages of its replay, and how a replay may differ from them."""

import gzip
import json
import math
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from resonator_daemon.mqtt.topics import DECODED
from resonator_daemon.tools.replay.outputs import payload_json
from resonator_daemon.tools.replay.source import open_replay

CORPUS = Path(__file__).parents[1] / "corpus"
RECORDING_FILE, EXPECTED_FILE = "recording.mcap", "expected.jsonl.gz"
KEPT_BYTES = 64_000  # JSON of each stream; of one that has more, each second message, each fourth...
TOLERANCE = 1e-6  # of the largest value that a field has in the case
DECODED_TOLERANCE = 1e-3  # single precision; rounding also depends on the position of arrays in memory
ABSENT = "nothing"
NOT_COMPARED = {"info": ("daemon_version", "commands")}  # of another version the same is expected


class Outcome(NamedTuple):
    """Result of a replay: frames, losses, messages by topic, and the messages that a case contains."""

    summary: dict[str, Any]
    messages: list[dict[str, Any]]


class Difference(NamedTuple):
    """A key and its two values."""

    key: str
    expected: object
    got: object


def replay_case(case: Path, every: Mapping[str, int] | None = None) -> Outcome:
    """Replay the recording of a case.

    Parameters
    ----------
    every
        By topic: n to keep every nth message; by default all events and states, and as many of streams as fit.
    """
    counts: Counter[str] = Counter()
    lines: list[dict[str, Any]] = []
    steps = dict(every or {})
    with open_replay(case / RECORDING_FILE) as replaying:
        for moment in replaying.moments():
            for topic, message in moment.messages:
                head = {"topic": topic.path, "number": counts[topic.path], "now_ns": str(moment.now.utc_ns)}
                lines.append(head | {"payload": json.loads(payload_json(message))})
                counts[topic.path] += 1
                if topic.qos == 1:
                    steps[topic.path] = 1
    for path in counts.keys() - steps.keys():
        sizes = [len(json.dumps(line["payload"], separators=(",", ":"))) for line in lines if line["topic"] == path]
        steps[path] = 1
        while sum(sizes[:: steps[path]]) > KEPT_BYTES and steps[path] < len(sizes):
            steps[path] *= 2
    counters = replaying.counters
    summary = {
        "frames": counters.frames,
        "frames_lost": asdict(counters.lost),
        "differences": replaying.differences,
        "damaged": replaying.damage is not None,
        "refused": list(replaying.refused),
        "messages": dict(counts),
        "every": {path: steps[path] for path in counts},
    }
    return Outcome(summary, [line for line in lines if line["number"] % steps[line["topic"]] == 0])


def save_case(recording: Path, case: Path) -> None:
    """Make a case of a recording; replaces an existing one."""
    shutil.rmtree(case, ignore_errors=True)
    case.mkdir()
    shutil.copyfile(recording, case / RECORDING_FILE)
    save_expected(case)


def save_expected(case: Path) -> None:
    """Write the messages that the present version computes from the recording of a case."""
    outcome = replay_case(case)
    lines = (json.dumps(line) + "\n" for line in (outcome.summary, *outcome.messages))
    with (case / EXPECTED_FILE).open("wb") as file, gzip.GzipFile("", "wb", fileobj=file, mtime=0) as packed:
        packed.write("".join(lines).encode())


def read_expected(case: Path) -> Outcome:
    with gzip.open(case / EXPECTED_FILE, "rt", encoding="utf-8") as file:
        summary, *messages = map(json.loads, file)
    return Outcome({key: value for key, value in summary.items() if key not in ("format", "sha256")}, messages)


def case_differences(expected: Outcome, got: Outcome) -> list[tuple[str, Difference]]:
    """Return each difference with the topic of its message, or `summary`."""
    decoded = DECODED.path in expected.summary["messages"]
    scales: dict[str, float] = {}  # the largest magnitude of each field; elements of a list are one field
    for line in expected.messages:
        for field, value in _floats(line["topic"], line["payload"]):
            scales[field] = max(scales.get(field, 0.0), abs(value))
    tolerance = DECODED_TOLERANCE if decoded else TOLERANCE
    found = [("summary", item) for item in _differences("", "", expected.summary, got.summary, {}, 0.0)]
    theirs = {(line["topic"], line["number"]): line for line in got.messages}
    for line in expected.messages:
        topic = line["topic"]
        other = theirs.pop((topic, line["number"]), None)
        if other is None:
            found.append((topic, Difference(f"message {line['number']}", "one", ABSENT)))
            continue
        one, another = (
            {key: value for key, value in side["payload"].items() if key not in NOT_COMPARED.get(topic, ())}
            for side in (line, other)
        )
        found += [(topic, item) for item in _differences("", topic, one, another, scales, tolerance)]
        if line["now_ns"] != other["now_ns"]:
            found.append((topic, Difference("(made)", line["now_ns"], other["now_ns"])))
    return found + [(topic, Difference(f"message {number}", ABSENT, "one")) for topic, number in theirs]


def _differences(
    key: str, field: str, expected: Any, got: Any, scales: Mapping[str, float], tolerance: float
) -> Iterator[Difference]:
    """Yield each key that differs; floats may differ by the tolerance, times the scale of their field."""
    if type(expected) is not type(got):
        yield Difference(key, expected, got)
    elif isinstance(expected, dict):
        for name in dict.fromkeys((*expected, *got)):
            inner = f"{key}.{name}" if key else str(name)
            if name in got and name in expected:
                yield from _differences(inner, f"{field}.{name}", expected[name], got[name], scales, tolerance)
            else:
                yield Difference(inner, expected.get(name, ABSENT), got.get(name, ABSENT))
    elif isinstance(expected, list):
        if len(expected) != len(got):
            yield Difference(f"{key}[]", f"{len(expected)} elements", f"{len(got)} elements")
        for number, (one, other) in enumerate(zip(expected, got, strict=False)):
            yield from _differences(f"{key}[{number}]", f"{field}[]", one, other, scales, tolerance)
    elif isinstance(expected, float):
        if not math.isclose(expected, got, rel_tol=0.0, abs_tol=tolerance * scales.get(field, 0.0)):
            yield Difference(key, expected, got)
    elif expected != got:
        yield Difference(key, expected, got)


def _floats(field: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _floats(f"{field}.{name}", inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _floats(f"{field}[]", inner)
    elif isinstance(value, float) and math.isfinite(value):
        yield field, value
