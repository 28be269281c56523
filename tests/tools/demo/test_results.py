"""What a demo's result says: which of it is a failure, which is only late, and the same losses as on the page."""

from typing import Any

import pytest

from resonator_daemon.tools.demo.results import delays, failures

LOST = dict.fromkeys(
    ("link_gap", "damaged", "board_overflow", "host_overrun", "queue_overflow", "publish_dropped", "skipped_late"), 0
)


def plate(**changes: Any) -> dict[str, Any]:
    fine = {
        "frames": 20_000, "lost": LOST, "latency_ms": {"p50": 1.0, "p99": 4.0}, "contacts_true": 9,
        "contacts_found": 9, "contacts_late": 0, "latest_contact_ms": None, "sites_right": 9,
        "decoded_frames": None, "messages_missed": 0
    }  # fmt: skip
    return fine | changes


@pytest.mark.parametrize(
    ("changes", "clause"),
    [
        ({"contacts_found": 7}, "2 of 9 touches missed: no onset event at the right site dated within 50 ms of it"),
        ({"contacts_found": 7, "sites_right": None}, "2 of 9 touches missed: no onset event dated within 50 ms of it"),
        ({"lost": LOST | {"link_gap": 3}}, "3 frames lost (link_gap)"),
        ({"frames": 0}, "no frame was received"),
        ({"decoded_frames": 0}, "no frame was decoded"),
    ],
)
def test_what_was_missed_or_lost_is_a_failure(changes: dict[str, Any], clause: str) -> None:
    assert failures(plate()) == delays(plate()) == []
    assert failures(plate(**changes)) == [clause]


def test_what_came_late_is_none() -> None:
    late = plate(
        lost=LOST | {"skipped_late": 4},
        contacts_late=2,
        latest_contact_ms=130.4,
        messages_missed=5,
        latency_ms={"p50": 3.0, "p99": 80.2},
    )
    assert failures(late) == []
    assert delays(late) == [
        "2 of 9 touches reported late: the onset event arrived more than 50 ms after the touch (at most 130 ms)",
        "5 messages not received (gaps in seq): skipped under load, not decoded, or lost on the way",
        "messages late: latency 80 ms (99th percentile)",
    ]
