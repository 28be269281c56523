"""Mistakes that people make in a configuration: each message names the key and what to do."""

import tomllib
from pathlib import Path

import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.values import plate_text
from resonator_daemon.daemon.service.config_store import load_checked

BROKEN = tomllib.loads(Path(__file__).with_name("broken_configs.toml").read_text(encoding="utf-8"))["case"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("broken")
    plate = load_plate("quartz16")
    good = plate_text(plate)
    first, second, *others = plate.sites
    twins = plate.model_copy(update={"sites": (first, second.model_copy(update={"tones": first.tones}), *others)})
    (folder / "damaged.toml").write_text("format 1\n")
    (folder / "format2.toml").write_text(good.replace("format = 1", "format = 2"))
    (folder / "twins.toml").write_text(plate_text(twins))
    return folder


@pytest.mark.parametrize("case", BROKEN, ids=[case["mistake"] for case in BROKEN])
def test_the_message_names_key_and_remedy(folder: Path, case: dict[str, str]) -> None:
    (folder / "board.toml").write_text(case["text"], encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load_checked(folder / "board.toml")
    told = "\n".join(caught.value.messages)
    assert any(case["names"] in message and case["remedy"] in message for message in caught.value.messages), told
    assert all("\n" not in message for message in caught.value.messages)
