"""Files of a calibration: the session until it is accepted, and the plate file, whole at any instant."""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

import tomlkit

from resonator_daemon.base.errors import UsageError, UserError, meaning_of
from resonator_daemon.base.host.files import (
    NoNewFileError,
    check_new,
    fresh_name,
    make_directory,
    replace_file,
    state_directory,
    sync_directory,
)
from resonator_daemon.base.plate import load_plate, shipped_plates
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from resonator_daemon.base.toml import read_toml
from resonator_daemon.tools.calibration.record import Record, rounded
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError


@dataclass(frozen=True)
class PlateFile:
    """The plate file that a configuration names, and where a calibration of it goes."""

    source: Path
    output: Path

    @classmethod
    def of(cls, config_path: Path, output: Path | None) -> "PlateFile":
        """Find the file.

        Raises
        ------
        UsageError
            The plate came with the daemon and no output is named.
        NoNewFileError
            The output cannot be written, or exists.
        """
        name = read_toml(config_path).content["plate"]
        if name in shipped_plates():
            source = Path(str(files("resonator_daemon.base.plates") / f"{name}.toml"))
            if output is None:
                sentence = f"plate {name!r} came with the daemon and is not overwritten; name a new plate file"
                raise UsageError(f"--output: {sentence}, as --output {name}-calibrated.toml")
        else:
            source = config_path.parent / name
        target = source if output is None else output
        if target.exists() and not source.samefile(target):
            check_new(target)
        directory = target.resolve().parent
        if not directory.is_dir() or not os.access(directory, os.W_OK):
            raise NoNewFileError(f"{target}: {directory} is no directory that can be written to")
        return cls(source, target)

    @property
    def digest(self) -> str:
        """Hash of the source, by which a change is detected."""
        return hashlib.sha256(self.source.read_bytes()).hexdigest()


def with_record(text: str, record: Record) -> str:
    """Return the text of a plate file with the record in it; sites that were not loaded keep their values."""
    document = tomlkit.parse(text)
    listed: Any = document["sites"]
    sites = {int(site["id"]): site for site in listed}
    for change in record.tones:
        tone = next(tone for tone in sites[change.site]["tones"] if tone["signal"] == FORCE_SIGNAL)
        tone["f0_hz"] = [round(value, 4) for value in change.f0_hz]
        for key in ("sensitivity", "temperature_coefficients"):
            if (values := getattr(change, key)) is not None:
                tone[key] = rounded(values)
    if record.response is not None:
        _table(document, "response").update(rounded(record.response.model_dump()))
    table = _table(document, "calibration")
    content = rounded(record.calibration.model_dump())
    coupling, validity = content.pop("coupling"), tomlkit.inline_table()
    validity.update(content.pop("validity"))
    table.update(content)
    table["residuals"].comment("newton rms, of these sites")
    if coupling:
        table["coupling"] = _coupling(coupling)
    table["validity"] = validity
    return tomlkit.dumps(document)


def _coupling(coupling: list[dict[str, Any]]) -> Any:
    """Return one line for each site that was pressed."""
    lines = tomlkit.array()
    for _, others in groupby(coupling, key=lambda pair: pair["pressed"]):
        for number, pair in enumerate(others):
            line = tomlkit.inline_table()
            line.update(pair | {"ratio": float(f"{pair['ratio']:.3g}")})
            lines.add_line(line, indent="" if number else "    ", newline=not number)
    lines.add_line(indent="")
    return lines


def _table(document: tomlkit.TOMLDocument, name: str) -> Any:
    if name not in document:
        document.add(tomlkit.nl())
        document.add(name, tomlkit.table())
    return document[name]


def write_plate_file(text: str, target: Path) -> None:
    """Check a plate file as the daemon would, then put it in place at once.

    Raises
    ------
    ConfigurationError
        The text is no plate file that can be used; nothing was written.
    """
    with tempfile.NamedTemporaryFile("w", suffix=".toml", encoding="utf-8", newline="") as checked:
        checked.write(text)
        checked.flush()
        load_plate(checked.name)
    target = target.resolve()  # a link stays a link
    try:
        replace_file(target, text.encode(), target.stat().st_mode & 0o7777 if target.exists() else None)
    except OSError as error:
        raise CalibrationRefusedError(f"{target}: cannot be written ({meaning_of(error)}); it is as before") from None


def name_plate(config_path: Path, plate: Path) -> None:
    """Have a configuration name a plate file; its comments and layout stay.

    Raises
    ------
    CalibrationRefusedError
        The configuration cannot be written; the plate file is accepted all the same.
    """
    path = config_path.resolve()  # a link stays a link
    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    if (path.parent / str(document["plate"])).resolve() == plate.resolve():
        return
    document["plate"] = plate.name if plate.parent.resolve() == path.parent else str(plate)
    before = path.stat()
    try:
        replace_file(path, tomlkit.dumps(document).encode(), before.st_mode & 0o7777)
        os.chown(path, before.st_uid, before.st_gid)
    except OSError as error:
        raise CalibrationRefusedError(
            f'{path}: cannot be written ({meaning_of(error)}); the calibration is in {plate}; set plate = "{plate}"'
        ) from None


def remove_remains(target: Path) -> None:
    """Remove what a write that was killed has left next to the plate file."""
    fresh_name(target.resolve()).unlink(missing_ok=True)


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
