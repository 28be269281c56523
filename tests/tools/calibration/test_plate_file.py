"""A record in a plate file: what changes, what stays, and that the file is whole or as before."""

import datetime
import os
from pathlib import Path

import pytest
from emulated_loads import SHIPPED

from resonator_daemon.base.errors import ConfigurationError, UsageError
from resonator_daemon.base.host.files import NoNewFileError
from resonator_daemon.base.plate import load_plate
from resonator_daemon.base.plate_tables import Calibration, Response, Validity
from resonator_daemon.tools.calibration.plate_file import PlateFile, with_record, write_plate_file
from resonator_daemon.tools.calibration.record import Record, ToneChange

RECORD = Record(
    Calibration(
        id="4f1e",
        date=datetime.date(2026, 11, 21),
        unit="EMU-0001",
        temperature_kelvin=297.5,
        model_error=0.012,
        sensitivity_std=0.001,
        sites=(7, 1),
        residuals=(2e-3, 1e-3),
        validity=Validity(force_newton=(0.0, 4.903), kelvin=(292.5, 302.5)),
        expiry=datetime.date(2027, 11, 21),
    ),
    Response(hysteresis_newton=0.1, creep_fraction=0.005, creep_time_s=20.0, relative_std=0.05),
    (
        ToneChange(7, [9991750.1, 9992155.2, 9991833.3, 9991787.4], [-5e-6, -5.1e-6, -5.2e-6, 5.3e-6]),
        ToneChange(1, [9975893.1] * 4, [-8e-6] * 4, [-5e-8, -5e-10, 1.08e-10]),
    ),
)


def test_the_daemon_reads_what_was_recorded(tmp_path: Path) -> None:
    path = tmp_path / "plate.toml"
    write_plate_file(with_record(SHIPPED.read_text(), RECORD), path)
    plate = load_plate(str(path))
    tones = plate.tones
    assert tones.f0_hz[6].tolist() == [9991750.1, 9992155.2, 9991833.3, 9991787.4]
    assert tones.sensitivity[6].tolist() == [-5e-6, -5.1e-6, -5.2e-6, 5.3e-6]
    assert tones.temperature_coefficients[0].tolist() == [-5e-8, -5e-10, 1.08e-10]
    assert plate.response == RECORD.response
    assert plate.calibration == RECORD.calibration


def test_comments_layout_and_sites_that_were_not_loaded_stay() -> None:
    before, after = SHIPPED.read_text().splitlines(), with_record(SHIPPED.read_text(), RECORD).splitlines()
    gone = [line for line in before if line not in after]
    assert gone == [
        "f0_hz = [9975893.1, 9976187.1, 9976124.2, 9975900.2]",
        "sensitivity = [-8.19e-6, -8.19e-6, -8.19e-6, -8.19e-6]",
        "f0_hz = [9991750.4, 9992155.4, 9991833.6, 9991787.2]",
        "sensitivity = [-5.42e-6, -5.42e-6, -5.42e-6, -5.42e-6]",
    ]
    assert sum(line.startswith("#") or "  #" in line for line in after) >= sum("#" in line for line in before)


def test_a_text_that_is_no_plate_file_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "plate.toml"
    path.write_text("before")
    text = with_record(SHIPPED.read_text(), RECORD)
    with pytest.raises(ConfigurationError, match="force_max_newton"):
        write_plate_file(text.replace("force_max_newton = 10", "force_max_newton = -1"), path)
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["plate.toml"]


def test_mode_and_symbolic_links_stay(tmp_path: Path) -> None:
    path, link = tmp_path / "plate.toml", tmp_path / "link.toml"
    path.write_text("before")
    path.chmod(0o640)
    link.symlink_to(path)
    write_plate_file(SHIPPED.read_text(), link)
    assert link.is_symlink()
    assert path.read_text() == SHIPPED.read_text()
    assert path.stat().st_mode & 0o777 == 0o640


def config_of(folder: Path, plate: str) -> Path:
    path = folder / "board.toml"
    path.write_text(f'plate = "{plate}"\nlink = "tcp://127.0.0.1:9"\n')
    return path


def test_a_shipped_plate_is_not_overwritten(tmp_path: Path) -> None:
    config = config_of(tmp_path, "quartz16")
    with pytest.raises(UsageError, match="--output: plate 'quartz16' came with the daemon"):
        PlateFile.of(config, None)
    file = PlateFile.of(config, tmp_path / "mine.toml")
    assert file.source.samefile(SHIPPED)
    assert file.output == tmp_path / "mine.toml"


def test_the_plates_own_file_is_changed_and_no_other(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(SHIPPED.read_text())
    (tmp_path / "other.toml").write_text("")
    config = config_of(tmp_path, "mine.toml")
    assert PlateFile.of(config, None).output == tmp_path / "mine.toml"
    assert PlateFile.of(config, tmp_path / "mine.toml").output == tmp_path / "mine.toml"
    with pytest.raises(NoNewFileError, match=r"other\.toml exists already"):
        PlateFile.of(config, tmp_path / "other.toml")
    with pytest.raises(NoNewFileError, match="no directory that can be written to"):
        PlateFile.of(config, tmp_path / "nowhere" / "mine.toml")
