"""What a running daemon takes of a changed configuration, and what it says of the rest."""

from pathlib import Path

import pytest
from config_files import loaded
from plates import with_counter

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.values import Changes, applied, changes, plate_text

BASE = 'name = "left"\nplate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n'


def test_nothing_changed(tmp_path: Path) -> None:
    """What is written out means the same as the default, and a plate is its content, not its file."""
    (tmp_path / "same.toml").write_text(plate_text(load_plate("quartz16")))
    old = loaded(tmp_path, BASE)
    new = loaded(tmp_path, BASE.replace("quartz16", "same.toml") + "[measurement]\nwindow_ms = 10\n")
    found = changes(old, new)
    assert found == Changes((), ())
    assert str(found) == "nothing changed"
    assert applied(old, new) == old


@pytest.mark.parametrize(
    ("text", "live", "restart"),
    [
        ("[measurement]\nwindow_ms = 20\nstep_ms = 10\n", ("measurement.window_ms", "measurement.step_ms"), ()),
        ('[commands]\nallow = ["mark"]\n', ("commands.allow",), ()),
        ("[recording]\nautostart = true\nmax_total_mb = 2000\n", ("recording.autostart", "recording.max_total_mb"), ()),
        ('[mqtt]\nprefix = "other"\n', (), ("mqtt.prefix",)),
        ('[decoding]\nmethod = "off"\n', (), ("decoding.method",)),
        ('[metrics]\nlisten = "127.0.0.1:1"\n', (), ("metrics.listen",)),
        ('[metrics]\nlisten = "127.0.0.1:1"\n[commands]\nallow = ["mark"]\n', ("commands.allow",), ("metrics.listen",)),
    ],
)
def test_keys_that_changed(tmp_path: Path, text: str, live: tuple[str, ...], restart: tuple[str, ...]) -> None:
    old, new = loaded(tmp_path, BASE), loaded(tmp_path, BASE + text)
    assert changes(old, new) == (live, restart)
    assert changes(new, old) == (live, restart)
    merged = applied(old, new)
    assert changes(old, merged) == (live, ())
    assert changes(merged, new) == ((), restart)


def test_windows_of_a_new_plate_wait_for_it(tmp_path: Path) -> None:
    plate = load_plate("quartz16")
    slow = with_counter(plate, frame_rate_hz=250.0)
    (tmp_path / "slow.toml").write_text(plate_text(slow))
    old = loaded(tmp_path, BASE + "[measurement]\nwindow_ms = 11\n")
    new = loaded(
        tmp_path,
        BASE.replace("quartz16", "slow.toml")
        + '[measurement]\nwindow_ms = 12\nstep_ms = 4\n[commands]\nallow = ["mark"]\n',
    )
    found = changes(old, new)
    assert found == (("commands.allow",), ("plate", "measurement.window_ms", "measurement.step_ms"))
    assert str(found) == "taken: commands.allow; restart for plate, measurement.window_ms, measurement.step_ms"
    merged = applied(old, new)
    assert merged.measurement == old.measurement
    assert merged.commands == new.commands
