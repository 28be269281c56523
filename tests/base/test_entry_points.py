"""Entry points of packages that a test installs next to the product."""

from pathlib import Path

import pytest

from resonator_daemon.base.entry_points import entry_names, load_entries, load_entry


def test_an_entry_that_cannot_be_used_costs_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = {"gone": "no_such_module", "lacks": "math:no_such", "exits": "exits", "wrong": "math:pi"}
    for package, entries in (("one", {"fine": "math:sin"}), ("two", {"fine": "math:cos", **broken})):
        info = tmp_path / package / f"{package}-1.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1\n")
        lines = [f"{name} = {value}\n" for name, value in entries.items()]
        (info / "entry_points.txt").write_text("".join(["[resonatord.tests]\n", *lines]))
        monkeypatch.syspath_prepend(info.parent)
    (tmp_path / "one" / "exits.py").write_text("raise SystemExit(3)\n")
    assert entry_names("tests") == ["exits", "fine", "gone", "lacks", "wrong"]
    assert capsys.readouterr().err == ""
    loaded = [dict(load_entries("tests", callable)) for _ in range(2)]
    assert [{name: found.__name__ for name, found in each.items()} for each in loaded] == [{"fine": "cos"}] * 2
    assert load_entry("tests", "absent", callable) is None
    warnings = capsys.readouterr().err.splitlines()
    assert [line.split()[2] for line in warnings] == ["exits", "gone", "lacks", "wrong"]
