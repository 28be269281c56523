"""URLs as values of a configuration."""

from typing import Final
from urllib.parse import SplitResult, urlsplit

_PART_MAX: Final = 63  # characters between the dots of a name (RFC 1035, section 2.3.4)


def split_url(url: str) -> SplitResult:
    """Split a URL; ValueError, without a password in it, where host or port cannot be read."""
    try:
        parts = urlsplit(url)
        readable = url.isprintable() and " " not in url and parts.port != 0
    except ValueError:
        readable = False
    if readable:
        _check_host(parts.hostname or "")
        return parts
    advice = "; write signs such as # / @ in a password as %23 %2F %40" if "@" in url else ""
    raise ValueError(f"host and port (1 to 65535) cannot be read{advice}")


def _check_host(host: str) -> None:
    """Raise ValueError for a name that no resolver takes: the look-up itself would fail in another way."""
    names = host.removesuffix(".").split(".") if host else []
    try:
        encoded = [name if name.isascii() else name.encode("idna") for name in names]
    except UnicodeError:
        encoded = [""]
    if not all(0 < len(name) <= _PART_MAX for name in encoded):
        raise ValueError(f"no host is called {host!r}: each part between dots has 1 to {_PART_MAX} letters or digits")
