"""Recordings at URLs: listing, temporary copies, and removal of secrets from URLs. Uses fsspec."""

import errno
import re
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from glob import has_magic
from typing import Any, Final

from resonator_daemon.base.errors import MissingLibraryError, meaning_of
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.board.recording.reader import FilePath, RecordingUnusableError

_MEANINGS: Final[dict[type, str]] = {FileNotFoundError: "no such file", FileExistsError: "it is a directory"}


@dataclass(frozen=True)
class LocalCopy:
    """Copy of the file at a URL, opened by `path` as any `os.PathLike`; messages name it by its URL.

    Attributes
    ----------
    path
        Of the copy, in this process.
    url
        Without secrets.
    """

    path: str
    url: str

    def __fspath__(self) -> str:
        return self.path

    def __str__(self) -> str:
        return self.url


@contextmanager
def local_file(path: str) -> Iterator[FilePath]:
    """Yield a path as it is, or a temporary copy of the file at a URL.

    The copy has no name: it is removed on exit, and also if the process is killed.

    Raises
    ------
    MissingLibraryError
        fsspec is not installed, or what it needs for this URL.
    RecordingUnusableError
        The file at the URL cannot be copied.
    """
    if "://" not in path:
        yield path
        return
    with ExitStack() as stack:
        try:
            file = stack.enter_context(tempfile.TemporaryFile())
        except OSError as error:
            why = f"no temporary file: {meaning_of(error)}; set TMPDIR to a writable directory"
            raise RecordingUnusableError(f"recording {without_secrets(path)}: {why}") from error
        try:
            copy = LocalCopy(f"/proc/self/fd/{file.fileno()}", without_secrets(path))
            with _file_system(path) as (files, remote_path):
                files.get_file(remote_path, copy.path)  # all at once: some servers send no parts
        except OSError as error:
            why = f"{meaning_of(error)}; check URL, permissions and server, then repeat"
            if error.errno == errno.ENOSPC:
                why = f"no space for a copy in {tempfile.gettempdir()}; set TMPDIR to another directory"
            raise RecordingUnusableError(f"recording {without_secrets(path)}: {why}") from error
        yield copy


def matching_urls(pattern: str) -> list[str]:
    """Return the URLs that match a pattern, sorted; those of `*.mcap` in a directory.

    The protocols are those of fsspec; tests read from HTTP and memory.

    Raises
    ------
    MissingLibraryError
        fsspec is not installed, or what it needs for this URL.
    OSError
        The server refuses the list.
    """
    with _file_system(pattern) as (files, path):
        # A server of HTTP would send the whole recording to answer whether it is a directory.
        if (plain := without_secrets(pattern)).endswith(".mcap") and not has_magic(plain):
            return [pattern]  # opening it reports why it cannot be read
        if files.isdir(path):
            path = f"{path.rstrip('/')}/*.mcap"
        return sorted(map(files.unstrip_protocol, files.glob(path)))


def without_secrets(text: str) -> str:
    """Return a URL, or a text that ends with one, without user information, query and fragment.

    A `?` without `key=` is a wildcard; of HTTP, each `?` begins a query.
    """
    begin, separator, rest = text.partition("://")
    key = "" if re.search("https?://", text) else "(?=[^/?#=]+=)"
    return begin + separator + re.sub(rf"(^|://)[^/?#]*@|(?:[?]{key}|#).*", r"\1", rest, flags=re.DOTALL)


@contextmanager
def _file_system(url: str) -> Iterator[tuple[Any, str]]:
    """Yield the file system of a URL and the path there; raise MissingLibraryError, or OSError for all else."""
    try:
        import fsspec

        files, path = fsspec.url_to_fs(url)
        files.invalidate_cache()  # lists of an earlier run of this process
        yield files, path
    except ImportError as error:
        # fsspec, or the library of the protocol, such as s3fs
        library = getattr(error.__cause__ or error, "name", None) or "fsspec"
        raise MissingLibraryError(f"{without_secrets(url)} needs {library}: {how_to_install(library)}") from error
    except Exception as error:  # each protocol raises its own exceptions
        meaning = _MEANINGS.get(type(error)) or without_secrets(meaning_of(error))
        raise OSError(getattr(error, "errno", None), meaning, without_secrets(url)) from error
