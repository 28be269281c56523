"""Files of a calibration: the session until it is accepted, and the plate file, whole at any instant."""

import datetime
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import Table

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
from resonator_daemon.base.plate_tables import FORCE_SIGNAL, Coupling
from resonator_daemon.base.toml import read_toml
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError


@dataclass(frozen=True)
class SiteRecord:
    """What a calibration found of one site; by channel (4,)."""

    site_id: int
    f0_hz: tuple[float, ...]
    sensitivity: tuple[float, ...]
    residual_newton: float  # rms
    temperature_coefficients: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class ResponseRecord:
    """Hysteresis and creep of all sites."""

    hysteresis_newton: float
    creep_fraction: float
    creep_time_s: float
    relative_std: float


@dataclass(frozen=True)
class Record:
    """Everything that goes into the plate file."""

    id: str
    date: datetime.date
    unit: str
    temperature_kelvin: float
    model_error: float
    sensitivity_std: float
    force_newton: tuple[float, float]  # lowest and highest
    kelvin: tuple[float, float]
    expiry: datetime.date
    sites: tuple[SiteRecord, ...]
    response: ResponseRecord | None
    untouched_hz: dict[int, list[float]] = field(default_factory=dict)  # f0 by channel (4,) of all sites, by id
    coupling: tuple[Coupling, ...] = ()


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
    found = {site.site_id: site for site in record.sites}
    tables: Any = document["sites"]
    for table in tables:
        if (untouched_hz := record.untouched_hz.get(int(table["id"]))) is not None:
            _force_tone(table)["f0_hz"] = [round(value, 4) for value in untouched_hz]
        if (site := found.get(int(table["id"]))) is not None:
            _set_site(table, site)
    if record.response is not None:
        response = _table(document, "response")
        for key, value in vars(record.response).items():
            response[key] = _rounded(value)
    _set_calibration(_table(document, "calibration"), record)
    return tomlkit.dumps(document)


def as_json(record: Record) -> dict[str, Any]:
    """Return [calibration] of the plate file, dates as text, with `response` and the `tones` that change."""
    found = {site.site_id: site for site in record.sites}
    f0_hz = {**record.untouched_hz, **{site.site_id: site.f0_hz for site in record.sites}}
    return {
        **_calibration(record),
        "date": record.date.isoformat(),
        "expiry": record.expiry.isoformat(),
        "validity": _validity(record),
        "coupling": [pair.model_dump() for pair in record.coupling],
        "response": None if record.response is None else asdict(record.response),
        "tones": [
            {
                "site": site_id,
                "f0_hz": values,
                "sensitivity": found[site_id].sensitivity if site_id in found else None,
                "temperature_coefficients": found[site_id].temperature_coefficients if site_id in found else None,
            }
            for site_id, values in f0_hz.items()
        ],
    }


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


def _set_site(table: Any, site: SiteRecord) -> None:
    tone = _force_tone(table)
    tone["f0_hz"] = [round(value, 4) for value in site.f0_hz]
    tone["sensitivity"] = [_rounded(value) for value in site.sensitivity]
    if site.temperature_coefficients is not None:
        tone["temperature_coefficients"] = [_rounded(value) for value in site.temperature_coefficients]


def _force_tone(table: Any) -> Any:
    return next(tone for tone in table["tones"] if tone["signal"] == FORCE_SIGNAL)


def _calibration(record: Record) -> dict[str, Any]:
    """Return what [calibration] holds besides validity and coupling."""
    return {
        "id": record.id,
        "date": record.date,
        "unit": record.unit,
        "temperature_kelvin": record.temperature_kelvin,
        "model_error": _rounded(record.model_error),
        "sensitivity_std": _rounded(record.sensitivity_std),
        "sites": [site.site_id for site in record.sites],
        "residuals": [_rounded(site.residual_newton) for site in record.sites],
        "expiry": record.expiry,
    }


def _validity(record: Record) -> dict[str, list[float]]:
    return {
        "force_newton": [_rounded(value) for value in record.force_newton],
        "kelvin": [_rounded(value) for value in record.kelvin],
    }


def _set_calibration(table: Any, record: Record) -> None:
    table.update(_calibration(record))
    table["residuals"].comment("newton rms, of these sites")
    if record.coupling:
        table["coupling"] = _coupling(record.coupling)
    validity = tomlkit.inline_table()
    validity.update(_validity(record))
    table["validity"] = validity


def _coupling(coupling: tuple[Coupling, ...]) -> Any:
    """One line for each site that was pressed."""
    lines = tomlkit.array()
    for pressed, others in groupby(coupling, key=lambda pair: pair.pressed):
        for number, pair in enumerate(others):
            line = tomlkit.inline_table()
            line.update({"pressed": pressed, "measured": pair.measured, "ratio": float(f"{pair.ratio:.3g}")})
            lines.add_line(line, indent="" if number else "    ", newline=not number)
    lines.add_line(indent="")
    return lines


def _table(document: tomlkit.TOMLDocument, name: str) -> Table:
    if name not in document:
        document.add(tomlkit.nl())
        document.add(name, tomlkit.table())
    table: Any = document[name]
    return table  # type: ignore[no-any-return]


def _rounded(value: float) -> float:
    return float(f"{value:.7g}")


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
