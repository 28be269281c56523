"""`resonatord compare`: what two recordings have in common, and in what they differ."""

import fcntl
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from command_line import exit_code

CORPUS = Path(__file__).parents[2] / "corpus"


def compared(capsys: pytest.CaptureFixture[str], a: str, b: str, *more: object) -> tuple[int, dict[str, Any]]:
    capsys.readouterr()
    code = exit_code("compare", *(CORPUS / case / "recording.mcap" for case in (a, b)), "--json", *more)
    return code, json.loads(capsys.readouterr().out)


def test_touches_losses_and_timing_are_those_of_each(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = compared(capsys, "touches", "lost-bytes")
    assert code == 0
    assert [touch["a"]["site"] for touch in found["touches"] if touch["a"]] == [7, 3, 16]
    peaks = [touch["a"]["peak_newton"] for touch in found["touches"] if touch["a"]]
    assert peaks == pytest.approx([1.95576, 0.44795, 7.84722], rel=1e-4)
    assert (sum(found["a"]["lost"].values()), sum(found["b"]["lost"].values()) > 0) == (0, True)
    assert found["a"]["frames"] == pytest.approx(100 * found["a"]["seconds"], rel=0.2)


def test_what_one_lacks_stands_beside_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = compared(capsys, "touches", "cut-off")
    assert (code, found["ok"], found["b"]["damage"]) == (1, False, "cut off")
    sites = [(touch["a"] and touch["a"]["site"], touch["b"] and touch["b"]["site"]) for touch in found["touches"]]
    assert (sites[0], sites[-1]) == ((7, 7), (16, None))
    with open(shutil.copy(CORPUS / "cut-off" / "recording.mcap", tmp_path), "rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert compared(capsys, "touches", str(tmp_path))[1]["b"]["damage"] == "still being written"
    code, found = compared(capsys, "touches", "touches")
    assert (code, all(touch["a"] == touch["b"] for touch in found["touches"])) == (0, True)


def test_the_table_names_what_differs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    files = [CORPUS / case / "recording.mcap" for case in ("touches", "lost-bytes")]
    assert exit_code("compare", *files) == 0
    printed = capsys.readouterr().out
    assert "touch 1, site 7: peak, N" in printed
    assert exit_code("compare", files[0], CORPUS / "gone.mcap") == 2
