"""Table `[mqtt]`: broker, authentication, prefix of the topics."""

import ssl
from collections.abc import Callable, Iterator
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Final, Self
from urllib.parse import unquote, urlsplit

from pydantic import (
    AfterValidator,
    Field,
    ModelWrapValidatorHandler,
    PlainValidator,
    PrivateAttr,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import InitErrorDetails

from resonator_daemon.base.toml import Table, check_with, finding, split_url
from resonator_daemon.board.config.broker_files import (
    BrokerFile,
    UnusableFileError,
    broker_file,
    load_certificates,
    open_to_all,
    read_certificates,
    read_key,
    read_password,
)

_PORTS: Final = {"mqtt": 1883, "mqtts": 8883}
_ADDRESS: Final = "must be mqtt://host:port, or mqtts://host:port for TLS"


def topic_level(text: str) -> str:
    """Return the text if it can be one level of an MQTT topic; raise ValueError otherwise."""
    if "/" in text or not _is_level(text):
        raise ValueError(
            "becomes part of MQTT topics: no space, /, +, # nor control character, no leading $, not empty"
        )
    return text


def topic_prefix(text: str) -> str:
    """Return a text that topics can begin with; ValueError if they cannot."""
    if not all(map(_is_level, text.split("/"))):
        raise ValueError(
            "begins MQTT topics: levels joined by /, each not empty, with no space, +, # nor control character and no "
            "leading $"
        )
    return text


def _is_level(text: str) -> bool:
    return text.isprintable() and bool(text) and not any(sign in text for sign in " +#") and not text.startswith("$")


def _broker_url(text: str) -> str:
    url = split_url(text)
    if url.scheme not in _PORTS or not url.hostname or url.path not in ("", "/") or url.query or url.fragment:
        raise ValueError(_ADDRESS)
    return text


def _user(text: str) -> str:
    if not text or not text.isprintable():
        raise ValueError("must be a name: printable characters, not empty")
    return text


def _file(check: Callable[[BrokerFile], object], value: object, info: ValidationInfo) -> BrokerFile:
    if not isinstance(value, str):
        raise ValueError("must be a string: a path, relative to this file or absolute, or credential:NAME")
    file = broker_file(value, info.context or Path())
    if file.path is not None:
        try:
            check(file)
        except UnusableFileError as error:
            raise ValueError(str(error)) from None
    return file


_PATH: Final = WithJsonSchema({"type": "string"})


class Mqtt(Table):
    """Broker, authentication and topic prefix."""

    url: Annotated[str, AfterValidator(_broker_url), Field(repr=False)] = Field(
        default="mqtt://127.0.0.1:1883",
        description="the broker: mqtt://HOST:PORT, or mqtts:// for TLS; default ports: 1883 and 8883",
        examples=["mqtt://127.0.0.1:1883", "mqtts://broker.example"],
    )
    prefix: Annotated[str, Field(max_length=200), AfterValidator(topic_prefix)] = Field(
        default="resonator", description="first level of the topics; may have several levels, as lab/one"
    )
    username: Annotated[str, Field(max_length=1000), AfterValidator(_user)] | None = Field(
        default=None, description="user name at the broker", examples=["left-index"]
    )
    password_file: Annotated[BrokerFile, PlainValidator(partial(_file, read_password)), _PATH] | None = Field(
        default=None,
        description="a file with the password of that account, alone on one line, or credential:NAME",
        examples=["left-index.password", "credential:mqtt-password"],
    )
    ca_file: Annotated[BrokerFile, PlainValidator(partial(_file, read_certificates)), _PATH] | None = Field(
        default=None,
        description="PEM file of the authorities that may have signed the broker's certificate, or credential:NAME; "
        "default: the system's",
        examples=["ca.crt"],
    )
    certificate_file: Annotated[BrokerFile, PlainValidator(partial(_file, read_certificates)), _PATH] | None = Field(
        default=None,
        description="PEM file of the daemon's own certificate, or credential:NAME",
        examples=["left-index.crt"],
    )
    key_file: Annotated[BrokerFile, PlainValidator(partial(_file, read_key)), _PATH] | None = Field(
        default=None,
        description="PEM file of that certificate's key, not encrypted, or credential:NAME",
        examples=["left-index.key", "credential:mqtt-key"],
    )

    _named_by: str = PrivateAttr("mqtt.url")

    @model_validator(mode="wrap")
    @classmethod
    def _keys_agree(cls, raw: Any, handler: ModelWrapValidatorHandler["Mqtt"]) -> "Mqtt":
        if not isinstance(raw, dict):
            return handler(raw)
        findings = list(_disagreements(raw))
        url_name = _url_name(raw)
        if url_name is not None and not findings:
            raw = raw | {"username": url_name}
        model = check_with(findings, handler, raw)
        if model.tls and all(file is None or file.path for file in model.certificates):
            try:
                load_certificates(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), *model.certificates)
            except UnusableFileError as error:
                key = "key_file" if model.key_file else "ca_file"
                return check_with([finding((key,), raw.get(key), str(error))], handler, raw)
        return model

    @property
    def named_by(self) -> str:
        """Key, option or argument that has the address, for errors: `mqtt.url`, if not set by `with_name`."""
        return self._named_by

    def with_name(self, named_by: str) -> Self:
        """Return the same broker with another `named_by`."""
        named = self.model_copy()
        named._named_by = named_by  # noqa: SLF001 - of this class
        return named

    @property
    def host(self) -> str:
        return urlsplit(self.url).hostname or ""

    @property
    def port(self) -> int:
        url = urlsplit(self.url)
        return url.port or _PORTS[url.scheme]

    @property
    def tls(self) -> bool:
        return urlsplit(self.url).scheme == "mqtts"

    @property
    def certificates(self) -> tuple[BrokerFile | None, BrokerFile | None, BrokerFile | None]:
        """Authorities to trust, own certificate, own key."""
        return self.ca_file, self.certificate_file, self.key_file

    @property
    def password(self) -> str | None:
        """The password in the URL, or the present content of `password_file`, which may change at any time.

        Raises
        ------
        UnusableFileError
            The file can no longer be read.
        """
        if self.password_file is not None:
            return read_password(self.password_file)
        password = urlsplit(self.url).password
        return None if password is None else unquote(password)

    def anonymous(self) -> "Mqtt":
        """Return the same broker without user name; a client certificate is still presented."""
        url = urlsplit(self.url)
        address = url._replace(netloc=url.netloc.rpartition("@")[2]).geturl()
        return self.model_copy(update={"url": address, "username": None, "password_file": None})

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings about settings that work but are less secure than they seem, or cannot be checked here."""
        secrets = {"password_file": self.password_file, "key_file": self.key_file}
        files = secrets | {"ca_file": self.ca_file, "certificate_file": self.certificate_file}
        notes = [
            f"mqtt.{key} = {str(file)!r} can be read by every user of this computer: chmod 600"
            for key, file in secrets.items()
            if file and open_to_all(file)
        ]
        notes += [
            f"mqtt.{key} = {file.name!r} is not looked at: only systemd passes credentials, by LoadCredential="
            for key, file in files.items()
            if file and file.path is None
        ]
        if self.username is not None and not self.tls and not is_this_computer(self.host):
            notes.append(f"mqtt.url: the password goes to {self.host} unencrypted; use mqtts://")
        return tuple(notes)


def _url_name(table: dict[str, Any]) -> str | None:
    try:
        name = split_url(str(table.get("url", ""))).username
    except ValueError:
        return None  # reported by the key's own check
    return None if name is None else unquote(name)


def _disagreements(table: dict[str, Any]) -> Iterator[InitErrorDetails]:
    """Yield faults of keys that are each valid on their own."""
    url = table.get("url", "mqtt://")
    if _url_name(table) is not None and ("username" in table or "password_file" in table):
        yield finding(("url",), url, "names a user, as username or password_file do; leave the user out of the URL")
    elif "password_file" in table and "username" not in table:
        yield finding(("password_file",), table["password_file"], "needs a username as well")
    for key, other in (("certificate_file", "key_file"), ("key_file", "certificate_file")):
        if key in table and other not in table:
            yield finding((key,), table[key], f"needs {other} as well; both may name the same file")
    for key in ("ca_file", "certificate_file", "key_file"):
        if key in table and isinstance(url, str) and url.startswith("mqtt:"):
            yield finding((key,), table[key], "has a meaning with TLS only; use mqtts:// in mqtt.url")


def is_this_computer(host: str) -> bool:
    """Return whether only programs of this computer reach an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
