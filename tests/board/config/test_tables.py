"""The tables [recording] and [metrics]: defaults, limits, and what is noted."""

from pathlib import Path

import pytest
from config_files import loaded, refusals

from resonator_daemon.board.config.tables import Listen

BASE = 'plate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n'


def test_nothing_is_recorded_or_served_unasked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/resonatord:/elsewhere")
    config = loaded(tmp_path, BASE)
    recording = config.recording
    assert recording.directory == Path("/var/lib/resonatord/recordings")
    assert (recording.autostart, recording.include_messages) == (False, False)
    assert (recording.file_max_mb, recording.file_max_minutes) == (1000, 60)
    assert (recording.max_total_mb, recording.min_free_mb) == (10_000, 500)
    assert config.metrics.listen is None
    assert config.notes == ()


@pytest.mark.parametrize(
    ("text", "listen", "loopback"),
    [
        ("127.0.0.1:9464", Listen("127.0.0.1", 9464), True),
        ("[::1]:1", Listen("::1", 1), True),
        ("localhost:65535", Listen("localhost", 65535), True),
        ("0.0.0.0:9464", Listen("0.0.0.0", 9464), False),
        ("robot.local:9464", Listen("robot.local", 9464), False),
    ],
)
def test_where_figures_can_be_had(tmp_path: Path, text: str, listen: Listen, loopback: bool) -> None:
    config = loaded(tmp_path, f'{BASE}[metrics]\nlisten = "{text}"\n')
    assert config.metrics.listen == listen
    assert str(listen) == text
    assert [text in note and "127.0.0.1" in note for note in config.notes] == ([] if loopback else [True])


@pytest.mark.parametrize(
    "listen", ['"9464"', '":9464"', '"127.0.0.1"', '"127.0.0.1:0"', '"127.0.0.1:70000"', '"http://127.0.0.1:9464"',
               '"127.0.0.1:9464/metrics"', '"me@127.0.0.1:9464"', '"a b:1"', "9464", "true"]
)  # fmt: skip
def test_an_address_that_is_none(tmp_path: Path, listen: str) -> None:
    (message,) = refusals(tmp_path, f"{BASE}[metrics]\nlisten = {listen}\n")
    assert message.startswith("4: metrics.listen: got ")
