"""Verbs under locales that lack the signs they write, and under one whose letters i are others."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

LOCALES = {
    "ascii": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    "ascii terminal": {"PYTHONIOENCODING": "ascii"},
    "turkish": {"LC_ALL": "tr_TR.ISO-8859-9", "PYTHONIOENCODING": "iso-8859-9"},
}
CONFIG = '# Ω, µ and İstanbul\nname = "hand"\nplate = "{plate}"\nlink = "serial:/dev/ttyACM0?baud=4000000"\n'


def run(*arguments: str, locale: str) -> "subprocess.CompletedProcess[bytes]":
    command = [sys.executable, "-m", "resonator_daemon.commands", *arguments]
    return subprocess.run(command, capture_output=True, env=os.environ | LOCALES[locale], check=False, timeout=60)


@pytest.mark.parametrize("locale", ["ascii", "turkish"])
def test_a_file_is_read_as_utf_8_and_its_mistakes_are_said_in_the_signs_there_are(tmp_path: Path, locale: str) -> None:
    config = tmp_path / "Ω.toml"
    config.write_text(CONFIG.format(plate="quartz16"), encoding="utf-8")
    good = run("check", str(config), "--json", locale=locale)
    assert good.returncode == 0, good.stderr
    assert json.loads(good.stdout)
    config.write_text(CONFIG.format(plate="İzmir-漢.toml"), encoding="utf-8")
    bad = run("check", str(config), locale=locale)
    assert bad.returncode == 78, bad.stderr
    assert b"Traceback" not in bad.stderr
    assert b"\\u6f22" in bad.stdout + bad.stderr


def test_a_report_on_stdout_has_signs_that_the_locale_lacks_by_their_numbers(tmp_path: Path) -> None:
    config = tmp_path / "board.toml"
    config.write_text(CONFIG.format(plate="quartz16").replace("/dev/", f"{tmp_path}/Ω/"), encoding="utf-8")
    done = run("doctor", "--config", str(config), "--seconds", "0.1", locale="ascii terminal")
    assert b"Traceback" not in done.stderr
    assert b"\\u03a9" in done.stdout


def test_a_port_that_this_locale_cannot_name_is_a_mistake_of_the_configuration(tmp_path: Path) -> None:
    config = tmp_path / "board.toml"
    config.write_text(CONFIG.format(plate="quartz16").replace("ttyACM0", "Ω"), encoding="utf-8")
    done = run("run", "--config", str(config), locale="ascii")
    assert done.returncode == 78, done.stderr
    assert b"Traceback" not in done.stderr
    assert b"set LC_ALL=C.UTF-8" in done.stderr
