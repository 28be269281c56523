"""Values of a configuration: a recording's own copy loads back equal; what a running daemon takes of changed ones."""

from datetime import date
from pathlib import Path

import pytest
from config_files import loaded
from plates import with_counter

from resonator_daemon.base.plate import load_plate
from resonator_daemon.base.plate_tables import Coupling
from resonator_daemon.board.config import values
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.links.carriers.recording import RecordingTarget

ORIGIN = Path("run.mcap/plate.toml")
LINK = RecordingTarget("run.mcap")


def test_a_calibrated_plate_loads_back_equal() -> None:
    plate = load_plate("quartz16")
    calibration = plate.calibration.model_copy(
        update={
            "id": 'a "quoted" \\ id\n\tß',
            "date": date(2026, 1, 2),
            "sites": (1, 2),
            "residuals": (1e-15, 0.1 + 0.2),
            "coupling": (Coupling(pressed=1, measured=2, ratio=-1 / 3),),
        }
    )
    plate = plate.model_copy(update={"calibration": calibration})
    assert values.load_plate_text(values.plate_text(plate), ORIGIN) == plate


def test_settings_load_back_equal(tmp_path: Path) -> None:
    base = 'plate = "skin32"\nlink = "tcp://127.0.0.1:1"\n'
    for table in (
        "",
        "[measurement]\nwindow_ms = 7.3\nstep_ms = 0.1\n",
        '[decoding]\nmethod = "fourier"\ncontact_physics = false\nuncertainty = false\nfriction_coefficient = 0.3\n',
        "[decoding]\nexternal = true\ndisplacement = false\n",
    ):
        config = loaded(tmp_path, base + table)
        settings = values.load_settings_text(values.settings_text(config), ORIGIN)
        assert (settings.measurement, settings.decoding) == (config.measurement, config.decoding)


def test_a_configuration_of_a_recordings_parts(tmp_path: Path) -> None:
    """The default step does not suit this plate's frames: what the recording carries holds."""
    slow = load_plate("quartz16")
    slow = with_counter(slow, frame_rate_hz=250.0)
    (tmp_path / "slow.toml").write_text(values.plate_text(slow))
    recorded = loaded(
        tmp_path, 'plate = "slow.toml"\nlink = "tcp://127.0.0.1:1"\n[measurement]\nwindow_ms = 12\nstep_ms = 4\n'
    )
    settings = values.load_settings_text(values.settings_text(recorded), ORIGIN)
    config = values.config_of(slow, settings, LINK, name="left", mqtt=Mqtt(prefix="again"))
    assert (config.name, config.plate, config.link, config.mqtt.prefix) == ("left", slow, LINK, "again")
    assert (config.measurement, config.decoding) == (recorded.measurement, recorded.decoding)
    assert values.config_of(slow, settings, LINK).mqtt == Mqtt()


BASE = 'name = "left"\nplate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n'


def test_nothing_changed(tmp_path: Path) -> None:
    """What is written out means the same as the default, and a plate is its content, not its file."""
    (tmp_path / "same.toml").write_text(values.plate_text(load_plate("quartz16")))
    old = loaded(tmp_path, BASE)
    new = loaded(tmp_path, BASE.replace("quartz16", "same.toml") + "[measurement]\nwindow_ms = 10\n")
    found = values.changes(old, new)
    assert found == values.Changes((), ())
    assert values.applied(old, new) == old


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
    assert values.changes(old, new) == (live, restart)
    assert values.changes(new, old) == (live, restart)
    merged = values.applied(old, new)
    assert values.changes(old, merged) == (live, ())
    assert values.changes(merged, new) == ((), restart)


def test_windows_of_a_new_plate_wait_for_it(tmp_path: Path) -> None:
    plate = load_plate("quartz16")
    slow = with_counter(plate, frame_rate_hz=250.0)
    (tmp_path / "slow.toml").write_text(values.plate_text(slow))
    old = loaded(tmp_path, BASE + "[measurement]\nwindow_ms = 11\n")
    new = loaded(
        tmp_path,
        BASE.replace("quartz16", "slow.toml")
        + '[measurement]\nwindow_ms = 12\nstep_ms = 4\n[commands]\nallow = ["mark"]\n',
    )
    found = values.changes(old, new)
    assert found == (("commands.allow",), ("plate", "measurement.window_ms", "measurement.step_ms"))
    merged = values.applied(old, new)
    assert merged.measurement == old.measurement
    assert merged.commands == new.commands
