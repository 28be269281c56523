"""Files that authenticate a connection to a broker: password, certificates, key."""

import os
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

MAX_FILE_BYTES: Final = 1 << 20  # bundles of authorities have some 200 kB
MAX_PASSWORD_BYTES: Final = 65_535  # what MQTT can carry

_CREDENTIAL: Final = "credential:"
_PEM_REMEDY: Final = "name a PEM file"


class UnusableFileError(OSError):
    """A file cannot authenticate a connection; the message names file, cause and remedy."""


@dataclass(frozen=True)
class BrokerFile:
    """A file named by its path, or as a credential that the service manager passes to the daemon."""

    name: str  # as the configuration has it
    path: Path | None  # None: a credential, while the service manager passes none

    def __str__(self) -> str:
        return str(self.path or self.name)


def broker_file(name: str, directory: Path) -> BrokerFile:
    """Return the file at a path, relative to the directory, or of `credential:NAME`.

    Raises ValueError where there is none.
    """
    if not name.isprintable() or not name.removeprefix(_CREDENTIAL):
        raise ValueError("must be a path, or credential:NAME")
    if not name.startswith(_CREDENTIAL):
        return BrokerFile(name, directory / name)
    credential = name.removeprefix(_CREDENTIAL)
    if "/" in credential or credential in (".", ".."):
        raise ValueError("must be credential:NAME, the name that LoadCredential= has in the unit, without /")
    given = os.environ.get("CREDENTIALS_DIRECTORY")
    return BrokerFile(name, Path(given) / credential if given else None)


def read_password(file: BrokerFile, what: str = "password") -> str:
    """Return the one line of a file, without its end; `what` it is, for messages.

    Raises
    ------
    UnusableFileError
        The file is missing, not readable, empty, or more than a password.
    """
    remedy = f"write the {what} into it, alone on one line"
    try:
        password = _read(file, remedy).decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        raise UnusableFileError(f"{file}: not UTF-8; {remedy}") from None
    if not password:
        raise UnusableFileError(f"{file}: is empty; {remedy}")
    if "\n" in password or "\0" in password or len(password.encode()) > MAX_PASSWORD_BYTES:
        raise UnusableFileError(f"{file}: more than a {what}; {remedy}")
    return password


def read_certificates(file: BrokerFile) -> None:
    """Check that a file holds PEM certificates; raise UnusableFileError where it does not."""
    _read_pem(file, b"CERTIFICATE-----", "certificate")


def read_key(file: BrokerFile) -> None:
    """Check that a file holds a private key without a password; raise UnusableFileError where it does not."""
    content = _read_pem(file, b"PRIVATE KEY-----", "private key")
    if b"ENCRYPTED" in content:
        raise UnusableFileError(f"{file}: the key is encrypted; decrypt it with `openssl pkey`, for the daemon's user")


def load_certificates(
    context: ssl.SSLContext,
    ca_file: BrokerFile | None,
    certificate_file: BrokerFile | None,
    key_file: BrokerFile | None,
) -> None:
    """Load trusted authorities (None: the system's) and, if named, a client certificate with its key into a context.

    Raises
    ------
    UnusableFileError
        A file is missing, not readable, not PEM, or the key is not that of the certificate.
    """
    if ca_file is None:
        context.load_default_certs(ssl.Purpose.SERVER_AUTH)
    else:
        read_certificates(ca_file)
        try:
            context.load_verify_locations(_path(ca_file))
        except ssl.SSLError as error:
            raise UnusableFileError(f"{ca_file}: cannot be used ({_reason(error)}); {_PEM_REMEDY}") from None
    if certificate_file is not None and key_file is not None:
        read_certificates(certificate_file)
        read_key(key_file)
        try:
            context.load_cert_chain(_path(certificate_file), _path(key_file), _refuse_to_ask)
        except ssl.SSLError as error:
            if error.reason == "KEY_VALUES_MISMATCH":
                raise UnusableFileError(
                    f"{key_file}: is not the key of {certificate_file}; name both of a pair"
                ) from None
            raise UnusableFileError(
                f"{certificate_file} and {key_file}: cannot be used ({_reason(error)}); {_PEM_REMEDY} each"
            ) from None


def open_to_all(file: BrokerFile) -> bool:
    """Whether every user of this computer may read the file."""
    try:
        return file.path is not None and bool(file.path.stat().st_mode & 0o004)
    except OSError:
        return False


def _path(file: BrokerFile) -> Path:
    if file.path is None:
        credential = file.name.removeprefix(_CREDENTIAL)
        raise UnusableFileError(
            f"{file}: no credentials were passed; put LoadCredential={credential}:PATH into the unit"
        )
    return file.path


def _read(file: BrokerFile, remedy: str) -> bytes:
    path = _path(file)
    try:
        if path.exists() and not path.is_file():
            raise UnusableFileError(f"{file}: not a regular file; {remedy}")
        with path.open("rb") as stream:
            content = stream.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError:
        raise UnusableFileError(f"{file}: no such file; {remedy}") from None
    except PermissionError:
        raise UnusableFileError(f"{file}: permission denied; let the daemon's user read it") from None
    if len(content) > MAX_FILE_BYTES:
        raise UnusableFileError(f"{file}: more than {MAX_FILE_BYTES} bytes; {remedy}")
    return content


def _read_pem(file: BrokerFile, mark: bytes, kind: str) -> bytes:
    content = _read(file, _PEM_REMEDY)
    if mark not in content:
        raise UnusableFileError(f"{file}: holds no {kind}; {_PEM_REMEDY} with one")
    return content


def _reason(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).replace("_", " ").lower()


def _refuse_to_ask() -> NoReturn:
    """Refuse a password, where OpenSSL would ask for one on the terminal."""
    raise UnusableFileError("the key is encrypted")
