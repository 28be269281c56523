"""A decoder's configuration: its own file or the daemon's, with every finding at once."""

from pathlib import Path

import pytest
from config_files import findings

from resonator_daemon.board.config import example_config
from resonator_daemon.board.config.clients import DecoderConfig, load_decoder_config


def loaded(tmp_path: Path, text: str) -> DecoderConfig:
    path = tmp_path / "decoder.toml"
    path.write_text(text)
    return load_decoder_config(path)


def test_the_daemons_file_will_do(tmp_path: Path) -> None:
    config = loaded(tmp_path, example_config())
    assert (config.name, config.mqtt.prefix, config.method) == ("left-index", "resonator", "open-plane")


def test_what_only_the_daemon_needs_is_passed_over_whatever_it_states(tmp_path: Path) -> None:
    text = (
        'name = "left"\nplate = "no such plate"\nlink = 7\nmeasurement = "?"\n[recording]\nx = 1\n[commands]\ny = 2\n'
    )
    assert loaded(tmp_path, text).name == "left"


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("", " name: missing"),
        ('name = "decoder"', "1: name: got 'decoder'"),
        ('name = "a"\n[mqtt]\nurll = ""', "3: mqtt.urll: unknown key"),
        ('name = "a"\n[decoding]\nmethod = "off"', "3: decoding.method: got 'off'"),
    ],
)
def test_a_finding_has_its_line_and_key(tmp_path: Path, text: str, place: str) -> None:
    (message,) = findings(lambda _: loaded(tmp_path, text), tmp_path / "decoder.toml")
    assert message.startswith(place)
