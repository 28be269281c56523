"""What of a demo's result is a failure, and what is only late."""

import pytest

from resonator_daemon.tools.demo.results import delays, failures

LOST = dict.fromkeys(("link_gap", "publish_dropped", "skipped_late"), 0)
FINE = {
    "frames": 20_000, "lost": LOST, "latency_ms": {"p50": 1.0, "p99": 4.0}, "contacts_true": 9, "contacts_found": 9,
    "contacts_late": 0, "latest_contact_ms": None, "sites_right": 9, "decoded_frames": None, "messages_missed": 0
}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "failed", "late"),
    [
        ({}, 0, 0),
        ({"contacts_found": 7}, 1, 0),
        ({"contacts_found": 7, "sites_right": None}, 1, 0),
        ({"lost": LOST | {"link_gap": 3, "publish_dropped": 1}}, 2, 0),
        ({"frames": 0}, 1, 0),
        ({"decoded_frames": 0}, 1, 0),
        ({"lost": LOST | {"skipped_late": 4}}, 0, 0),
        ({"contacts_late": 2, "latest_contact_ms": 130.4}, 0, 1),
        ({"messages_missed": 5}, 0, 1),
        ({"latency_ms": {"p50": 3.0, "p99": 80.2}}, 0, 1),
    ],
)
def test_each_failure_and_each_delay_is_a_clause(changes: dict[str, object], failed: int, late: int) -> None:
    assert (len(failures(FINE | changes)), len(delays(FINE | changes))) == (failed, late)
