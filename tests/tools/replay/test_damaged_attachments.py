"""A recording whose plate file or settings are not what was written gives no numbers with them, and says so."""

import json
from pathlib import Path

import pytest
from command_line import exit_code

RECORDING = Path(__file__).parents[2] / "corpus" / "touches" / "recording.mcap"
WHOLE = RECORDING.read_bytes()
FORCE_MAX = b"force_max_newton = "
SETTING = WHOLE.index(b"window_ms = ") + 12


def flipped(path: Path, place: int, bit: int = 2) -> Path:
    """Write the recording with one bit the other way."""
    bent = bytearray(WHOLE)
    bent[place] ^= bit
    path.write_bytes(bent)
    return path


def in_plate() -> int:
    place = WHOLE.index(FORCE_MAX) + len(FORCE_MAX)
    assert WHOLE[place : place + 4] == b"10.0"
    return place  # 10.0 becomes 30.0


@pytest.mark.parametrize(("name", "place"), [("plate.toml", in_plate()), ("settings.toml", SETTING)])
def test_no_numbers_follow_from_it(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, place: int) -> None:
    path = flipped(tmp_path / "bent.mcap", place)
    for verb in (("replay", path, "--to"), ("export", path, "--output")):
        output = tmp_path / "out.csv"
        assert exit_code(*verb, output, "--json") == 78
        error = json.loads(capsys.readouterr().out)["error"]
        assert (error["code"], f"attachment {name} " in error["message"]) == ("config", True)
        assert not output.exists()
