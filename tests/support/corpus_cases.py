"""Cases of tests/corpus: a recording, the messages of its replay, and how a replay may differ from them."""

import gzip
import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from resonator_daemon.mqtt.topics import DECODED
from resonator_daemon.tools.replay.outputs import payload_json
from resonator_daemon.tools.replay.recorded_pipeline import open_replay

CORPUS = Path(__file__).parents[1] / "corpus"
RECORDING_FILE, EXPECTED_FILE = "recording.mcap", "expected.jsonl.gz"
KEPT_BYTES = 64_000  # JSON of each stream; of one that has more, each second message, each fourth...
TOLERANCE = 1e-6  # of the largest value that a field has in the case
DECODED_TOLERANCE = 1e-3  # single precision; rounding also depends on the position of arrays in memory
ABSENT = "nothing"
NOT_COMPARED = {"info": ("daemon_version", "commands")}  # of another version the same is expected


class Outcome(NamedTuple):
    """What a replay came to: frames, losses, messages by topic; and of the messages those that a case keeps."""

    summary: dict[str, Any]
    messages: list[dict[str, Any]]


def replay_case(case: Path, every: Mapping[str, int] | None = None) -> Outcome:
    """Replay the recording of a case.

    Parameters
    ----------
    every
        By topic: keep each so manieth message; without it all events and states, and of streams as many as fit.
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
    """Make a case of a recording, in the place of one that is there."""
    shutil.rmtree(case, ignore_errors=True)
    case.mkdir()
    shutil.copyfile(recording, case / RECORDING_FILE)
    save_expected(case)


def save_expected(case: Path) -> None:
    """Write what the present version makes of the recording of a case."""
    outcome = replay_case(case)
    lines = (json.dumps(line) + "\n" for line in (outcome.summary, *outcome.messages))
    with (case / EXPECTED_FILE).open("wb") as file, gzip.GzipFile("", "wb", fileobj=file, mtime=0) as packed:
        packed.write("".join(lines).encode())


def read_expected(case: Path) -> Outcome:
    with gzip.open(case / EXPECTED_FILE, "rt", encoding="utf-8") as file:
        summary, *messages = map(json.loads, file)
    return Outcome({key: value for key, value in summary.items() if key not in ("format", "sha256")}, messages)


def case_differences(expected: Outcome, got: Outcome) -> dict[str, tuple[object, object]]:
    """Return both values of each key that differs, by topic, number and key.

    Floats may differ by the tolerance, times the largest magnitude of their field in the case; elements of a list are
    one field.
    """
    tolerance = DECODED_TOLERANCE if DECODED.path in expected.summary["messages"] else TOLERANCE
    ours, theirs = dict(_leaves(expected)), dict(_leaves(got))
    scales: dict[str, float] = {}
    for field, value in ours.values():
        if isinstance(value, float):
            scales[field] = max(scales.get(field, 0.0), abs(value))
    differences: dict[str, tuple[object, object]] = {}
    for key in dict.fromkeys((*ours, *theirs)):
        (field, one), (_, other) = ours.get(key, ("", ABSENT)), theirs.get(key, ("", ABSENT))
        near = isinstance(one, float) and isinstance(other, float) and abs(one - other) <= tolerance * scales[field]
        if not near and (type(one) is not type(other) or one != other):
            differences[key] = one, other
    return differences


def _leaves(outcome: Outcome) -> Iterator[tuple[str, tuple[str, Any]]]:
    """Yield each value with its key and its field; a list has its length, too."""
    yield from _within("summary", "summary", outcome.summary)
    for line in outcome.messages:
        topic, left_out = line["topic"], NOT_COMPARED.get(line["topic"], ())
        payload = {key: value for key, value in line["payload"].items() if key not in left_out}
        yield from _within(f"{topic} {line['number']}", topic, {"(made)": line["now_ns"], **payload})


def _within(key: str, field: str, value: Any) -> Iterator[tuple[str, tuple[str, Any]]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _within(f"{key} {name}", f"{field} {name}", inner)
    elif isinstance(value, list):
        yield f"{key}[]", (field, len(value))
        for number, inner in enumerate(value):
            yield from _within(f"{key}[{number}]", f"{field}[]", inner)
    else:
        yield key, (field, value)
