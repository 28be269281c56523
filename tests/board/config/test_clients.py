"""A decoder's configuration: its own file or the daemon's, with every finding at once."""

from pathlib import Path

import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.board.config import example_config
from resonator_daemon.board.config.clients import DecoderConfig, load_decoder_config


def loaded(tmp_path: Path, text: str) -> DecoderConfig:
    path = tmp_path / "decoder.toml"
    path.write_text(text)
    return load_decoder_config(path)


def refused(tmp_path: Path, text: str) -> tuple[str, ...]:
    with pytest.raises(ConfigurationError) as raised:
        loaded(tmp_path, text)
    return tuple(message.partition("decoder.toml:")[2] for message in raised.value.messages)


def test_the_daemons_file_will_do(tmp_path: Path) -> None:
    config = loaded(tmp_path, example_config())
    assert (config.name, config.mqtt.prefix, config.method) == ("left-index", "resonator", "open-plane")


def test_what_only_the_daemon_needs_is_passed_over_whatever_it_states(tmp_path: Path) -> None:
    text = (
        'name = "left"\nplate = "no such plate"\nlink = 7\nmeasurement = "?"\n[recording]\nx = 1\n[commands]\ny = 2\n'
    )
    assert loaded(tmp_path, text).name == "left"


@pytest.mark.parametrize(
    ("text", "sentences"),
    [
        ("", (" name: missing",)),
        ('name = "decoder"', ("1: name: got 'decoder'; is the topic of decoder processes; choose another",)),
        ('name = "a"\n[mqtt]\nurll = ""', ("3: mqtt.urll: unknown key; did you mean url?",)),
        ('name = "a"\n[decoding]\nmethod = "off"', ('2: decoding: got a table; method = "off" leaves a decoder',)),
    ],
)
def test_each_finding_is_one_sentence_with_its_line(tmp_path: Path, text: str, sentences: tuple[str, ...]) -> None:
    found = refused(tmp_path, text)
    assert len(found) == len(sentences)
    for message, sentence in zip(found, sentences, strict=True):
        assert message.startswith(sentence)
