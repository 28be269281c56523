"""URLs as values of a configuration."""

from urllib.parse import SplitResult, urlsplit


def split_url(url: str) -> SplitResult:
    """Split a URL; ValueError, without a password in it, where host or port cannot be read."""
    try:
        parts = urlsplit(url)
        if url.isprintable() and " " not in url and parts.port != 0:
            return parts
    except ValueError:
        pass
    advice = "; write signs such as # / @ in a password as %23 %2F %40" if "@" in url else ""
    raise ValueError(f"host and port (1 to 65535) cannot be read{advice}")
