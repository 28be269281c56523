"""A calibration that a power failure interrupts; power failures at any moment are in tests/test_soak_commands.py."""

import hashlib
from pathlib import Path

import pytest

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.values import plate_text
from resonator_daemon.tools.calibration.plate_file import Session
from resonator_daemon.tools.calibration.run import accept_staged


def test_a_calibration_that_was_interrupted_while_it_was_accepted_is_accepted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    quartz16 = load_plate("quartz16")
    before, after = plate_text(quartz16), plate_text(quartz16.model_copy(update={"force_max_newton": 5.0}))
    plate, session = tmp_path / "own.toml", Session(tmp_path / "left.toml")
    staged = {"id": "a", "source": str(plate), "output": str(plate), "record": {}, "notes": [], "plate_file": after}
    with session.recording():
        session.write("staged", staged | {"sha256": hashlib.sha256(before.encode()).hexdigest()})
    plate.write_text(after)
    accept_staged(tmp_path / "left.toml", as_json=True)
    assert (plate.read_text(), session.staged()) == (after, None)
