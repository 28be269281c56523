"""The golden corpus: every scenario and fault replays as it did."""

import json
import os
from pathlib import Path

import pytest
from command_line import run_command
from corpus_cases import CORPUS, EXPECTED_FILE, case_differences, read_expected, replay_case

from resonator_daemon.commands import main

CASES = sorted(path.parent for path in CORPUS.glob(f"*/{EXPECTED_FILE}"))


def test_the_corpus_is_there_and_small() -> None:
    assert len(CASES) >= 30
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < 4.1e6


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_case_becomes_what_it_did(case: Path) -> None:
    expected = read_expected(case)
    assert len(expected.messages) >= 6
    assert case_differences(expected, replay_case(case, expected.summary["every"])) == {}


def test_the_corpus_has_what_may_befall_a_board() -> None:
    seen: set[tuple[str, object]] = set()
    for case in CASES:
        expected = read_expected(case)
        seen |= {("lost", cause) for cause, count in expected.summary["frames_lost"].items() if count}
        seen |= {("damaged", expected.summary["damaged"])}
        for message in expected.messages:
            payload = message["payload"]
            seen |= {(key, payload[key]) for key in ("state", "status", "event") if key in payload}
    assert seen >= {("lost", cause) for cause in ("link_gap", "damaged", "board_overflow")}
    assert seen >= {("state", state) for state in ("waiting", "stalled", "lost", "refused", "pressed_at_start")}
    assert seen >= {("event", event) for event in ("onset", "release", "incipient_slip")}
    assert seen >= {("status", s) for s in ("ok", "overload", "no_signal", "possibly_more", "rejected", "settling")}
    assert ("damaged", True) in seen


@pytest.mark.parametrize(("topic", "listed", "limit_bytes"), [("forces", "sites", 350), ("contacts", "contacts", 405)])
def test_a_message_with_one_touch_is_small(topic: str, listed: str, limit_bytes: int) -> None:
    long_run = {"name": "left-index", "daemon_boot_id": "9f3c52d0", "seq": 1_234_567, "board_ticks": "1234567890123"}
    messages = read_expected(CORPUS / "touches").messages
    payloads = [message["payload"] for message in messages if message["topic"] == topic]
    touched = [payload for payload in payloads if len(payload[listed]) == 1 and payload["status"] == "ok"]
    assert len(touched) > 50
    assert max(len(json.dumps(payload | long_run, separators=(",", ":"))) for payload in touched) <= limit_bytes


def test_replays_are_equal_to_the_byte_in_every_process(tmp_path: Path) -> None:
    """In this one, and in one that orders sets and dicts otherwise."""
    here, there = tmp_path / "here.jsonl", tmp_path / "there.jsonl"
    arguments = ["replay", str(CORPUS / "rebooted" / "recording.mcap"), "--to"]
    assert main([*arguments, str(here)]) == 0
    assert run_command(*arguments, there, env=os.environ | {"PYTHONHASHSEED": "20261121"}).returncode == 0
    assert here.read_bytes() == there.read_bytes()
    assert here.read_bytes().count(b"\n") > 300
