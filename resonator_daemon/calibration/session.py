"""The session file: everything that a calibration captured, in the user's state directory until it is accepted."""

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from resonator_daemon.calibration.refusal import CalibrationRefusedError
from resonator_daemon.errors import UserError
from resonator_daemon.host.new_file import make_directory, sync_directory
from resonator_daemon.host.places import state_directory
from resonator_daemon.host.system_limits import meaning_of


class Session:
    """One calibration of one configuration: a line of JSON for each thing captured, the staged result last."""

    def __init__(self, config_path: Path) -> None:
        """Name the session after the configuration, which has one at a time; nothing is read or written yet."""
        resolved = config_path.resolve()
        digest = hashlib.sha256(str(resolved).encode()).hexdigest()[:8]
        self.path = state_directory() / "calibrations" / f"{resolved.stem}-{digest}.jsonl"

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Begin again, over what an interrupted calibration left; `write` works within the context."""
        try:
            make_directory(self.path.parent)
            self._stream = self.path.open("w", encoding="utf-8", buffering=1)
            sync_directory(self.path.parent)
        except OSError as error:
            raise UserError(f"{self.path}: cannot be written ({meaning_of(error)}); set XDG_STATE_HOME") from None
        with self._stream:
            yield

    def write(self, kind: str, content: Any) -> None:
        """Append one line; on the disk when this returns."""
        self._stream.write(json.dumps({kind: content}) + "\n")
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def staged(self) -> dict[str, Any] | None:
        """Return the result that waits to be accepted, None where there is none."""
        try:
            last = self.path.read_text(encoding="utf-8").rstrip("\n").rpartition("\n")[2]
        except FileNotFoundError:
            return None
        try:
            result = json.loads(last).get("staged")
        except (ValueError, AttributeError):  # the end of an interrupted one
            return None
        return result if isinstance(result, dict) else None

    def staged_or_refuse(self) -> dict[str, Any]:
        """Return the result that waits; CalibrationRefusedError where there is none."""
        if (result := self.staged()) is None:
            raise CalibrationRefusedError(f"no calibration of this configuration is staged ({self.path})")
        return result

    def archive(self, calibration_id: str) -> Path:
        """Keep what was captured under the calibration's id."""
        kept = self.path.with_name(f"{calibration_id}.jsonl")
        os.replace(self.path, kept)
        sync_directory(kept.parent)
        return kept

    def discard(self) -> None:
        """Remove the file; it stays removed after a power failure."""
        with suppress(FileNotFoundError):
            self.path.unlink()
            sync_directory(self.path.parent)
