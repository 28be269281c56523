"""The judge of a long run finds what it is there to find: leaks, holes, books that do not balance, strange lines."""

from typing import Any

import numpy as np
import pytest
from long_run_judge import Leg, Sample, Seen, judge
from long_run_log import Cause, LogJudge


def samples(count: int, **changing: Any) -> list[Sample]:
    """Give a sample each 30 s; what is not said stays as it is."""
    steady = {
        "rss_mb": 120.0,
        "malloc_mb": 28.0,
        "python_blocks": 425e3,
        "file_descriptors": 20.0,
        "threads": 6.0,
        "tasks": 9.0,
        "recordings_mb": 1.0,
    }
    return [
        Sample(30.0 * n, **(steady | {key: float(values[n]) for key, values in changing.items()})) for n in range(count)
    ]


def well(**other: Any) -> Seen:
    seen = Seen(
        samples=samples(120, malloc_mb=28.0 + np.random.default_rng(1).normal(0.0, 0.05, 120)),
        legs=[Leg("no faults", 1000, 3, 0, 900, 0)],
        healths=100,
        messages=1000,
        lines=50,
        asked=10,
        files=5,
        files_removed=2,
        exit_code=0,
    )
    for key, value in other.items():
        setattr(seen, key, value)
    return seen


def missed(seen: Seen) -> list[str]:
    return [row.what for row in judge(seen) if not row.good]


@pytest.mark.parametrize(
    ("other", "what"),
    [
        ({"accounts_off": ["bytes_in 1, their fates 2"]}, "accounts that do not balance"),
        ({"holes": 1}, "messages missing without a word"),
        ({"out_of_order": 1}, "messages out of order"),
        ({"unexplained": ["a line"]}, "log lines that nothing explains"),
        ({"refused": ["status: 1"]}, "questions without an answer"),
        ({"recordings_over_mb": 0.5}, "recordings above their budget"),
        ({"files_removed": 0}, "old recordings removed"),
        ({"events_missing": 1}, "pieces in no recording"),
        ({"exit_code": 1}, "exit code on SIGTERM"),
        ({"legs": [Leg("no faults", 1000, 0, 0, 600, 0)]}, "whole frames that did not arrive"),
        ({"legs": [Leg("no faults", 1000, 0, 0, 1010, 0)]}, "whole frames that did not arrive"),
        ({"cut_short": True}, "time"),
        ({"samples": []}, "memory in use"),
        ({"samples": samples(120, malloc_mb=np.arange(120) / 60)}, "memory in use"),
        ({"samples": samples(120, python_blocks=np.arange(120) * 60)}, "Python's blocks in use"),
        ({"samples": samples(120, rss_mb=np.arange(120) / 6)}, "memory of the process"),
        ({"samples": samples(120, threads=np.arange(120) // 40)}, "threads"),
        ({"samples": samples(120, file_descriptors=np.arange(120) // 40)}, "file descriptors"),
    ],
)
def test_each_figure_can_be_missed(other: dict[str, Any], what: str) -> None:
    assert what in missed(well(**other))


def test_a_line_needs_its_cause_at_its_time() -> None:
    log = LogJudge([(r"WARNING link lost: .*", (Cause.GONE, Cause.REBOOT)), (r"INFO file \d+", (Cause.ALWAYS,))])
    line = "WARNING link lost: unplugged"
    assert log.unexplained("INFO file 7", 5.0) is None
    assert "without a cause" in (log.unexplained(line, 5.0) or "")
    log.did(Cause.FREEZE, 8.0, 9.0)
    log.did(Cause.GONE, 10.0, 12.0)
    assert "without a cause" in (log.unexplained(line, 9.0) or "")
    assert log.unexplained(line, 11.0) is None
    assert log.unexplained(line, 31.0) is None
    assert "without a cause" in (log.unexplained(line, 33.0) or "")
    assert "unknown" in (log.unexplained(f"{line}\n", 11.0) or "")
    assert "unknown" in (log.unexplained("Traceback (most recent call last):", 11.0) or "")
