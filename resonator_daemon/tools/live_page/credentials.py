"""Secrets of the live page, from files: its token, its certificate with the key."""

import ssl
from pathlib import Path

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.board.config.broker_files import (
    BrokerFile,
    UnusableFileError,
    read_certificates,
    read_key,
    read_password,
)
from resonator_daemon.mqtt.tls import LEAST_VERSION
from resonator_daemon.tools.live_page.access import TOKEN_CHARACTERS_MIN


def read_token(path: Path) -> str:
    """Return the token in a file, alone on one line.

    Raises
    ------
    ConfigurationError
        The file cannot be read, or the token can be guessed.
    """
    try:
        token = read_password(BrokerFile(str(path), path), "token")
    except UnusableFileError as error:
        raise ConfigurationError(f"--token-file {error}") from None
    if len(token) < TOKEN_CHARACTERS_MIN or not token.isascii():
        raise ConfigurationError(
            f"--token-file {path}: the token has {len(token)} characters; at least {TOKEN_CHARACTERS_MIN}, all ASCII, "
            f"are needed. Make one: openssl rand -hex 16 > {path}"
        )
    return token


def tls_of(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the context of a server with this certificate and key.

    Raises
    ------
    ConfigurationError
        One of both cannot be used.
    """
    certificate_file, key_file = BrokerFile(str(certificate), certificate), BrokerFile(str(key), key)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = LEAST_VERSION
    try:
        read_certificates(certificate_file)
        read_key(key_file)
        context.load_cert_chain(certificate, key)
    except UnusableFileError as error:
        raise ConfigurationError(f"--tls-certificate, --tls-key: {error}") from None
    except ssl.SSLError as error:
        raise ConfigurationError(
            f"--tls-key {key}: cannot be used with {certificate} ({error.reason}); name both of a pair"
        ) from None
    return context
