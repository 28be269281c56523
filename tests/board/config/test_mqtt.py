"""The table [mqtt]: addresses, names and files, each mistake told with its remedy and without a password."""

import os
from pathlib import Path

import config_files
import pytest
import trustme

from resonator_daemon.board.config import Config
from resonator_daemon.board.config.broker_files import BrokerFile, UnusableFileError, read_password

BOARD = 'plate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n[mqtt]\n'
FIRST = 4  # line of the first key
TLS = 'url = "mqtts://h"\n'


@pytest.fixture
def _files(tmp_path: Path) -> None:
    authority, other = trustme.CA(), trustme.CA()
    client = authority.issue_cert(common_name="left")
    authority.cert_pem.write_to_path(tmp_path / "ca.crt")
    client.cert_chain_pems[0].write_to_path(tmp_path / "left.crt")
    client.private_key_pem.write_to_path(tmp_path / "left.key")
    other.issue_cert(common_name="left").private_key_pem.write_to_path(tmp_path / "other.key")
    (tmp_path / "password").write_text("open sesame\n")
    for name in ("password", "left.key", "other.key"):
        (tmp_path / name).chmod(0o600)


def loaded(tmp_path: Path, table: str) -> Config:
    return config_files.loaded(tmp_path, BOARD + table)


def refusals(tmp_path: Path, table: str) -> list[str]:
    """Return the messages without the file's path, with the line counted within the table."""
    messages = [message.partition(":") for message in config_files.refusals(tmp_path, BOARD + table)]
    return [f"{int(line) - FIRST + 1}:{text}".replace(f"{tmp_path}/", "") for line, _, text in messages]


@pytest.mark.usefixtures("_files")
def test_files_are_found_beside_the_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    mqtt = loaded(
        tmp_path,
        'url = "mqtts://broker"\nusername = "robot"\npassword_file = "password"\nca_file = "ca.crt"\n'
        'certificate_file = "left.crt"\nkey_file = "left.key"\n',
    ).mqtt
    assert (mqtt.username, mqtt.password) == ("robot", "open sesame")
    paths = [file.path for file in mqtt.certificates if file is not None]
    assert paths == [tmp_path / "ca.crt", tmp_path / "left.crt", tmp_path / "left.key"]


def test_a_user_in_the_address(tmp_path: Path) -> None:
    mqtt = loaded(tmp_path, 'url = "mqtt://ann:p%40ss@localhost"\n').mqtt
    assert (mqtt.username, mqtt.password) == ("ann", "p@ss")
    assert "p%40ss" not in repr(mqtt)
    nobody = mqtt.anonymous()
    assert (nobody.username, nobody.password, nobody.url) == (None, None, "mqtt://localhost")


@pytest.mark.usefixtures("_files")
def test_systemd_passes_files_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = 'username = "robot"\npassword_file = "credential:password"\n'
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    assert loaded(tmp_path, table).mqtt.password == "open sesame"
    (tmp_path / "password").unlink()
    (message,) = refusals(tmp_path, table)
    assert message.startswith("2: mqtt.password_file: got 'credential:password'; password: no such file; write the")


def test_a_credential_cannot_be_looked_at_from_a_shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    config = loaded(tmp_path, 'username = "robot"\npassword_file = "credential:password"\n')
    (note,) = config.notes
    assert note.startswith("mqtt.password_file = 'credential:password' is not looked at")
    with pytest.raises(UnusableFileError, match="LoadCredential=password:PATH"):
        _ = config.mqtt.password


@pytest.mark.usefixtures("_files")
@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ('url = "mqtt://a:b@h"\npassword_file = "password"', "1: mqtt.url: got 'mqtt://***@h'; names a user"),
        ('username = ""', "1: mqtt.username: got ''"),
        ('password_file = "password"', "1: mqtt.password_file: got 'password'; needs a username"),
        ('ca_file = "ca.crt"\nurl = "mqtt://h"', "1: mqtt.ca_file: got 'ca.crt'"),
        (f'{TLS}certificate_file = "left.crt"\nkey_file = "other.key"', "3: mqtt.key_file: got 'other.key'"),
        (f'{TLS}ca_file = "credential:../x"', "2: mqtt.ca_file: got 'credential:../x'; must be credential:NAME"),
        (f"{TLS}insecure = true", "2: mqtt.insecure: unknown key"),
    ],
)
def test_one_mistake(tmp_path: Path, table: str, expected: str) -> None:
    (message,) = refusals(tmp_path, table + "\n")
    assert message.startswith(expected)


FILES = {
    "missing": ("password_file", None, "no such file; write the password into it, alone on one line"),
    "empty": ("password_file", b"\n", "is empty; write the password"),
    "two lines": ("password_file", b"one\ntwo\n", "more than a password; write the password"),
    "latin": ("password_file", b"\xe9\n", "not UTF-8; write the password"),
    "huge": ("password_file", b"x" * (1 << 20) + b"x", "more than 1048576 bytes"),
    "no certificate": ("ca_file", b"hello\n", "holds no certificate; name a PEM file with one"),
    "broken certificate": ("ca_file", b"-----BEGIN CERTIFICATE-----\nhello\n", "cannot be used ("),
    "no key": ("key_file", b"hello\n", "holds no private key; name a PEM file with one"),
    "encrypted key": ("key_file", b"-----BEGIN ENCRYPTED PRIVATE KEY-----\n", "the key is encrypted; decrypt it with"),
    "broken key": ("key_file", b"-----BEGIN PRIVATE KEY-----\nhello\n", "cannot be used ("),
}


@pytest.mark.usefixtures("_files")
@pytest.mark.parametrize("case", FILES)
def test_a_file_that_cannot_serve(case: str, tmp_path: Path) -> None:
    key, content, expected = FILES[case]
    if content is not None:
        (tmp_path / "bad").write_bytes(content)
    keys = {"password_file": 'username = "robot"', "key_file": 'certificate_file = "left.crt"', "ca_file": ""}
    (message,) = refusals(tmp_path, f'url = "mqtts://h"\n{keys[key]}\n{key} = "bad"\n')
    assert message.startswith(f"3: mqtt.{key}: got 'bad'; ")
    assert f"bad: {expected}" in message


def test_only_regular_files_that_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "closed").write_text("x")
    table = 'username = "robot"\npassword_file = "{}"\n'
    for name in ("pipe", "."):
        (message,) = refusals(tmp_path, table.format(name))
        assert "not a regular file; write the password into it" in message

    def denied(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", denied)  # root reads everything
        with pytest.raises(UnusableFileError) as caught:
            read_password(BrokerFile("closed", tmp_path / "closed"))
    assert str(caught.value).endswith("closed: permission denied; let the daemon's user read it")


@pytest.mark.usefixtures("_files")
def test_secrets_that_others_can_read_are_noted(tmp_path: Path) -> None:
    table = (
        'url = "mqtts://broker"\nusername = "robot"\npassword_file = "password"\n'
        'certificate_file = "left.crt"\nkey_file = "left.key"\n'
    )
    assert loaded(tmp_path, table).notes == ()
    (tmp_path / "left.crt").chmod(0o644)
    (tmp_path / "password").chmod(0o604)
    (tmp_path / "left.key").chmod(0o644)
    assert [note.partition(" can be")[0] for note in loaded(tmp_path, table).notes] == [
        f"mqtt.password_file = '{tmp_path}/password'",
        f"mqtt.key_file = '{tmp_path}/left.key'",
    ]


@pytest.mark.parametrize(
    ("host", "noted"), [("localhost", False), ("127.0.0.1", False), ("[::1]", False), ("broker", True)]
)
def test_a_password_in_clear_over_a_network_is_noted(tmp_path: Path, host: str, noted: bool) -> None:
    notes = loaded(tmp_path, f'url = "mqtt://robot:sesame@{host}"\n').notes
    assert notes == ((f"mqtt.url: the password goes to {host} unencrypted; use mqtts://",) if noted else ())
    assert loaded(tmp_path, f'url = "mqtts://robot:sesame@{host}"\n').notes == ()
