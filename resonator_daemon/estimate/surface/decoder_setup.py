"""Set-up of decoders, with a cache in the user's directory.

What takes seconds to set up is kept under a hash of all that it depends on.
"""

import contextlib
import hashlib
import logging
import os
import pickle
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.errors import meaning_of, reason_of
from resonator_daemon.base.host.files import cache_directory
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder

log = logging.getLogger(__name__)

Built = TypeVar("Built")

CANNOT_DECODE = (ValueError, ArithmeticError, MemoryError)

_KEPT = 4  # files of some 80 MB
_LEFT_S = 3600.0
_CHECKSUM_BYTES = 4
_CODE = Path(__file__).parent, Path(__file__).parent.parent / "elastic"


def set_up(skin: Skin, options: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]) -> SkinDecoder:
    """Build a decoder, or load it from the cache; raises one of CANNOT_DECODE if neither succeeds."""
    try:
        return cached((skin, options, noise_std), lambda: SkinDecoder(skin, options, noise_std, progress))
    except CANNOT_DECODE:
        raise
    except Exception as error:  # a skin from the network may be anything; others can be decoded
        log.exception("decoder could not be set up")
        raise ValueError(f"decoder could not be set up: {error!r}") from error


def cached(depends_on: Any, build: Callable[[], Built]) -> Built:
    """Return what `build` returned for the same data, code and libraries, or let it build.

    Whatever is wrong with the cache only costs the time to build.
    """
    path = cache_directory() / f"{_hash(depends_on)}.pickle"
    try:
        built: Built = _load(path)
    except FileNotFoundError:
        pass
    except Exception as error:  # noqa: BLE001  a pickle written by other code may raise anything
        log.warning("cached set-up %s cannot be used and is built again: %s", path, meaning_of(error))
    else:
        with contextlib.suppress(OSError):  # where it may only be read
            path.touch()
        return built
    content = pickle.dumps(build(), protocol=5)
    try:
        _keep(path, content)
    except OSError as error:
        log.info("set-up is not cached: %s", reason_of(error))
    # As from the cache: matrices that lie in memory otherwise give results that differ in their last digits.
    rebuilt: Built = pickle.loads(content)
    return rebuilt


def _load(path: Path) -> Any:
    """Read a set-up; what damage does to it depends on where it is, so that a checksum is compared first."""
    content = memoryview(path.read_bytes())
    pickled, checksum = content[:-_CHECKSUM_BYTES], content[-_CHECKSUM_BYTES:]
    if _checksum(pickled) != checksum:
        raise ValueError("its checksum does not match its content")
    return pickle.loads(pickled)


def _checksum(content: memoryview | bytes) -> bytes:
    return zlib.crc32(content).to_bytes(_CHECKSUM_BYTES, "big")


def _hash(depends_on: Any) -> str:
    digest = hashlib.sha256(pickle.dumps((depends_on, np.__version__, scipy.__version__), protocol=5))
    for path in sorted(source for folder in _CODE for source in folder.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:32]


def _keep(path: Path, content: bytes) -> None:
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as part:
        try:
            part.write(content)
            part.write(_checksum(content))
            part.flush()
            os.replace(part.name, path)
        except BaseException:
            os.unlink(part.name)
            raise
    for left in path.parent.glob("*.part"):  # by a program that was killed while it wrote
        if time.time() - left.stat().st_mtime > _LEFT_S:
            left.unlink(missing_ok=True)
    by_age = sorted(path.parent.glob("*.pickle"), key=lambda file: file.stat().st_mtime)
    for file in by_age[:-_KEPT]:
        file.unlink(missing_ok=True)
