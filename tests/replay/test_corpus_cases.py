"""The golden corpus: every scenario and fault replays as it did, and what counts as a difference."""

import gzip
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import exit_code

from resonator_daemon.commands import main
from resonator_daemon.errors import ConfigurationError, ExitCode
from resonator_daemon.replay.case import EXPECTED_FILE, read_expected, save_case
from resonator_daemon.replay.checking import ABSENT, Difference, Scales, Verdict, check_case, payload_differences

CORPUS = Path(__file__).parents[1] / "corpus"
EXPECTED = {"a": 1, "b": "one", "f": [0.0, 2.0], "g": [{"x": 1e-9}, {"x": 4e-9}], "n": None, "t": True}
CASES = sorted(path.parent for path in CORPUS.glob(f"*/{EXPECTED_FILE}"))


def check(case: Path) -> Verdict:
    return check_case(case, read_expected(case))


def test_the_corpus_is_there_and_small() -> None:
    assert len(CASES) >= 30
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < 4e6


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_case_becomes_what_it_did(case: Path) -> None:
    verdict = check(case)
    assert not verdict.differences, [str(finding) for finding in verdict.first]
    assert verdict.messages >= 6


def test_the_corpus_has_what_may_befall_a_board() -> None:
    seen: set[tuple[str, object]] = set()
    for case in CASES:
        expected = read_expected(case)
        seen |= {("lost", cause) for cause, count in expected.summary["frames_lost"].items() if count}
        seen |= {("damaged", expected.summary["damaged"])}
        for message in expected.messages:
            payload = message.payload
            seen |= {(key, payload[key]) for key in ("state", "status", "event") if key in payload}
    assert seen >= {("lost", cause) for cause in ("link_gap", "damaged", "board_overflow")}
    assert seen >= {("state", state) for state in ("waiting", "stalled", "lost", "refused", "pressed_at_start")}
    assert seen >= {("event", event) for event in ("onset", "release", "incipient_slip")}
    assert seen >= {("status", s) for s in ("ok", "overload", "no_signal", "possibly_more", "rejected", "settling")}
    assert ("damaged", True) in seen


@pytest.mark.parametrize(("topic", "listed", "limit_bytes"), [("forces", "sites", 350), ("contacts", "contacts", 400)])
def test_a_message_with_one_touch_is_small(topic: str, listed: str, limit_bytes: int) -> None:
    long_run = {"name": "left-index", "daemon_boot_id": "9f3c52d0", "seq": 1_234_567, "board_ticks": "1234567890123"}
    payloads = [message.payload for message in read_expected(CORPUS / "touches").messages if message.topic == topic]
    touched = [payload for payload in payloads if len(payload[listed]) == 1 and payload["status"] == "ok"]
    assert len(touched) > 50
    assert max(len(json.dumps(payload | long_run, separators=(",", ":"))) for payload in touched) <= limit_bytes


def retold(folder: Path, change: Callable[[list[dict[str, Any]]], object], name: str = "refused") -> Path:
    """A case with other lines in what it expects."""
    case = folder / name
    shutil.copytree(CORPUS / name, case)
    with gzip.open(case / EXPECTED_FILE, "rt") as file:
        lines = [json.loads(line) for line in file]
    change(lines)
    with gzip.open(case / EXPECTED_FILE, "wt") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)
    return case


def forces_with_a_site(lines: list[dict[str, Any]]) -> dict[str, Any]:
    payloads: list[dict[str, Any]] = [line["payload"] for line in lines[1:] if line["topic"] == "forces"]
    pressed = [payload for payload in payloads if payload["sites"]]
    return max(pressed, key=lambda payload: payload["sites"][0]["force_newton"] or 0.0)


def later(record: dict[str, Any], key: str) -> None:
    record[key] = str(int(record[key]) + 1)


def weaker(lines: list[dict[str, Any]]) -> None:
    forces_with_a_site(lines)["sites"][0]["force_newton"] *= 1 + 1e-4


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (weaker, "sites[0].force_newton"),
        (lambda lines: forces_with_a_site(lines).update(status="settling"), "status"),
        (lambda lines: later(forces_with_a_site(lines), "t_ns"), "t_ns"),
        (lambda lines: later(lines[2], "now_ns"), "(made)"),
        (lambda lines: lines[0]["messages"].update({"contacts/event": 99}), "messages.contacts/event"),
        (lambda lines: lines.append(lines[-1] | {"number": 10**6}), "message 1000000"),
        (lambda lines: lines.pop(3), "message 1"),
    ],
)
def test_what_is_wrong_is_found(change: Callable[[list[dict[str, Any]]], object], key: str, tmp_path: Path) -> None:
    verdict = check(retold(tmp_path, change, "touches"))
    assert [finding.difference.key for finding in verdict.first] == [key]


def test_a_difference_is_printed_and_ends_with_a_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def online(lines: list[dict[str, Any]]) -> None:
        (refused,) = [line["payload"] for line in lines[1:] if line["payload"].get("state") == "refused"]
        refused["state"] = "online"

    case = retold(tmp_path, online)
    assert exit_code("replay", "--check", case, CORPUS / "overload") == ExitCode.FAILED
    output = capsys.readouterr()
    assert output.out.startswith("DIFFERS refused: 1 differences\n        state/link at ")
    assert 's: state: expected "online", got "refused"\n' in output.out
    assert "ok      overload: " in output.out
    assert output.err.endswith("2 fixtures, 1 differ\n")
    assert exit_code("replay", "--check", case, "--json") == ExitCode.FAILED
    printed = json.loads(capsys.readouterr().out)
    assert (printed["ok"], printed["error"]["code"], printed["cases"][0]["differences"]) == (False, "differs", 1)


@pytest.mark.parametrize(
    "content",
    [b"", b"nothing", gzip.compress(b""), gzip.compress(b"[]\n"), None],
    ids=["empty", "no gzip", "no line", "no header", "no file"],  # the bytes of gzip tell the time
)
def test_what_is_no_case_is_reported(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / EXPECTED_FILE).write_bytes(content)
    with pytest.raises(ConfigurationError, match=EXPECTED_FILE):
        read_expected(tmp_path)


def test_a_case_of_a_case_is_the_same(tmp_path: Path) -> None:
    save_case(CORPUS / "refused" / "recording.mcap", tmp_path / "again")
    assert read_expected(tmp_path / "again") == read_expected(CORPUS / "refused")


def test_replays_are_equal_to_the_byte_in_every_process(tmp_path: Path) -> None:
    """In this one, and in one that orders sets and dicts otherwise."""
    here, there = tmp_path / "here.jsonl", tmp_path / "there.jsonl"
    arguments = ["replay", str(CORPUS / "rebooted" / "recording.mcap"), "--to"]
    assert main([*arguments, str(here)]) == 0
    command = [sys.executable, "-m", "resonator_daemon", *arguments, there]
    environment = os.environ | {"PYTHONHASHSEED": "20261121"}
    subprocess.run(command, check=True, env=environment, capture_output=True, timeout=60)
    assert here.read_bytes() == there.read_bytes()
    assert here.read_bytes().count(b"\n") > 300


def test_a_case_that_is_interrupted_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("resonator_daemon.replay.case.write_expected", interrupted)
    recording = CORPUS / "refused" / "recording.mcap"
    assert main(["replay", str(recording), "--save-case", str(tmp_path / "case")]) == 1
    assert capsys.readouterr().err == "resonatord: interrupted: no fixture is saved\n"
    assert list(tmp_path.iterdir()) == []


def differences(got: dict[str, Any], topic: str = "forces") -> list[Difference]:
    scales = Scales()
    scales.add(topic, EXPECTED)
    return list(payload_differences(topic, EXPECTED, got, scales))


@pytest.mark.parametrize("change", [{}, {"f": [1.9e-6, 2.0 - 1.9e-6]}, {"g": [{"x": 1e-9 + 3.9e-15}, {"x": 4e-9}]}])
def test_what_other_processors_round_is_none(change: dict[str, Any]) -> None:
    assert differences(EXPECTED | change) == []


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"a": 2}, Difference("a", 1, 2)),
        ({"a": 1.0}, Difference("a", 1, 1.0)),
        ({"n": 0.0}, Difference("n", None, 0.0)),
        ({"f": [2.1e-6, 2.0]}, Difference("f[0]", 0.0, 2.1e-6)),
        ({"f": [0.0, 2.0, 3.0]}, Difference("f[]", "2 elements", "3 elements")),
        ({"g": [{"x": 1e-9 + 4.1e-15}, {"x": 4e-9}]}, Difference("g[0].x", 1e-9, 1e-9 + 4.1e-15)),
        ({"g": [{}, {"x": 4e-9}]}, Difference("g[0].x", 1e-9, ABSENT)),
        ({"more": 1}, Difference("more", ABSENT, 1)),
    ],
)
def test_what_is_one(change: dict[str, Any], found: Difference) -> None:
    assert differences(EXPECTED | change) == [found]


def test_the_largest_value_of_a_field_sets_its_scale_in_whatever_order_they_come() -> None:
    for values in ([0.0, 2.0], [2.0, 0.0], [-2.0, 1.0, 0.5]):
        scales = Scales()
        scales.add("forces", {"f": values})
        assert scales.tolerance("forces.f[]") == pytest.approx(2e-6)


def test_another_version_states_the_same() -> None:
    scales = Scales()
    old, new = {"plate": "p", "daemon_version": "0.8"}, {"plate": "p", "daemon_version": "0.9"}
    assert list(payload_differences("info", old | {"commands": []}, new | {"commands": ["ping"]}, scales)) == []
    assert list(payload_differences("forces", old, new, scales)) == [Difference("daemon_version", "0.8", "0.9")]
