"""A power failure at any moment: each store keeps what it promised, and nothing that is half written is used."""

from pathlib import Path

import pytest
from store_failures import READERS, fail_while_writing
from store_writers import NEW_PLATE_TEXT, PLATE_TEXT, staged

from resonator_daemon.calibration.plate_file import Session
from resonator_daemon.calibration.run import accept_staged


@pytest.mark.parametrize("store", list(READERS))
def test_a_power_failure_at_any_moment_costs_nothing_that_was_promised(
    store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    count, wrong = fail_while_writing(store, tmp_path, others=10, seed=1)
    assert wrong == []
    assert count > 10


def test_a_calibration_that_was_interrupted_while_it_was_accepted_is_accepted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    plate, session = tmp_path / "own.toml", Session(tmp_path / "left.toml")
    plate.write_text(PLATE_TEXT)
    with session.recording():
        session.write("staged", staged(plate, NEW_PLATE_TEXT, "a"))
    plate.write_text(NEW_PLATE_TEXT)
    accept_staged(tmp_path / "left.toml", as_json=True)
    assert (plate.read_text(), session.staged()) == (NEW_PLATE_TEXT, None)
