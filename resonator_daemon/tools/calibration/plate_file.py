"""The plate file that a calibration changes: whole at any instant."""

import os
import tempfile
from dataclasses import dataclass
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

import tomlkit

from resonator_daemon.base.errors import UsageError, meaning_of
from resonator_daemon.base.host.files import NoNewFileError, check_new, replace_file
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
    def is_new(self) -> bool:
        """Whether the result goes into another file than the plate's own."""
        return not (self.output.exists() and self.source.samefile(self.output))


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
        table_of(document, "response").update(rounded(record.response.model_dump()))
    table = table_of(document, "calibration")
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


def table_of(document: tomlkit.TOMLDocument, name: str) -> Any:
    """Return a table of a document, added where there is none."""
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
