"""A recording whose plate file or settings are not what was written gives no numbers with them, and says so."""

import json
from pathlib import Path

import pytest

from resonator_daemon.commands import main
from resonator_daemon.recording.reader import open_recording

RECORDING = Path(__file__).parents[1] / "corpus" / "touches" / "recording.mcap"
WHOLE = RECORDING.read_bytes()
ATTACHMENT = 9  # its opcode
FORCE_MAX = b"force_max_newton = "


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def flipped(path: Path, place: int, bit: int = 2) -> Path:
    """Write the recording with one bit the other way."""
    bent = bytearray(WHOLE)
    bent[place] ^= bit
    path.write_bytes(bent)
    return path


def content_of(name: bytes) -> range:
    """Where the content of an attachment's record is."""
    begin = WHOLE.index(name) - 4 - 16  # the length of its name, two times
    assert WHOLE[begin - 9] == ATTACHMENT
    return range(begin, begin + int.from_bytes(WHOLE[begin - 8 : begin], "little"))


def in_plate() -> int:
    place = WHOLE.index(FORCE_MAX) + len(FORCE_MAX)
    assert WHOLE[place : place + 4] == b"10.0"
    return place  # 10.0 becomes 30.0


def in_settings() -> int:
    return WHOLE.index(b"window_ms = ") + len(b"window_ms = ")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A configuration of the recording's plate and settings."""
    with open_recording(str(RECORDING)) as recording:
        plate, settings = recording.plate_text, recording.settings_text
        name = recording.header["name"]
    (tmp_path / "own.toml").write_text(plate or "")
    path = tmp_path / "board.toml"
    link = "serial:/dev/null?baud=4000000"
    path.write_text(f'name = "{name}"\nplate = "own.toml"\nlink = "{link}"\n{settings}')
    return path


@pytest.mark.parametrize(("name", "place"), [("plate.toml", in_plate()), ("settings.toml", in_settings())])
def test_no_numbers_follow_from_it(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, place: int) -> None:
    path = flipped(tmp_path / "bent.mcap", place)
    for verb in (("replay", path, "--to"), ("export", path, "--output")):
        output = tmp_path / "out.csv"
        assert run(*verb, output, "--json") == 78
        said = capsys.readouterr()
        line = f"{path}: its attachment {name} is damaged; give plate and settings with --config FILE"
        assert said.err == f"resonatord: {line}\n"
        assert json.loads(said.out)["error"]["message"] == line
        assert not output.exists()


@pytest.mark.parametrize("name", [b"plate.toml", b"settings.toml"])
def test_each_byte_counts(tmp_path: Path, name: bytes) -> None:
    content = content_of(name)
    for place in [*content[:60], *content[60:-40:97], *content[-40:]]:
        path = flipped(tmp_path / "bent.mcap", place, 1 << place % 8)
        with open_recording(str(path)) as recording:
            assert len(recording.damaged_attachments) == 1
            assert (recording.plate_text is None) == (name == b"plate.toml")
            assert (recording.settings_text is None) == (name == b"settings.toml")
            next(recording.events())
            assert recording.damage is None
