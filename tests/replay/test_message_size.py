"""Bytes of the two messages that a controller reads 200 times a second, in the recorded touches of quartz16."""

import gzip
import json
from pathlib import Path

import pytest

TOUCHES = Path(__file__).parents[1] / "corpus" / "touches" / "expected.jsonl.gz"
LONG_RUN = {"name": "left-index", "daemon_boot_id": "9f3c52d0", "seq": 1_234_567, "board_ticks": "1234567890123"}


@pytest.mark.parametrize(("topic", "listed", "limit_bytes"), [("forces", "sites", 350), ("contacts", "contacts", 400)])
def test_a_message_with_one_touch_is_small(topic: str, listed: str, limit_bytes: int) -> None:
    lines = [json.loads(line) for line in gzip.decompress(TOUCHES.read_bytes()).splitlines()[1:]]
    payloads = [line["payload"] for line in lines if line.get("topic") == topic]
    touched = [payload for payload in payloads if len(payload[listed]) == 1 and payload["status"] == "ok"]
    assert len(touched) > 50
    assert max(len(json.dumps(payload | LONG_RUN, separators=(",", ":"))) for payload in touched) <= limit_bytes
