"""`resonatord calibrate`: opens the board's link, leads through the steps, stages the result, accepts or aborts it."""

import json
import secrets
import sys
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import ConfigurationError, ExitCode, InterruptedCommandError, UsageError
from resonator_daemon.base.host.signals import interruptible
from resonator_daemon.base.host.text import print_note
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from resonator_daemon.board.config import load_config
from resonator_daemon.board.session.frames import BoardOnline
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.tools.calibration.load_procedure import Loading, LoadProcedure, Prompt
from resonator_daemon.tools.calibration.load_readings import CapturedLoads, MultitoneLoads, board_readings
from resonator_daemon.tools.calibration.outcome import (
    Outcome,
    OutlierSite,
    find_outliers,
    fit_loadings,
    refuse_unknown_sensitivity,
)
from resonator_daemon.tools.calibration.plate_file import (
    PlateFile,
    Session,
    name_plate,
    remove_remains,
    with_record,
    write_plate_file,
)
from resonator_daemon.tools.calibration.record import make_record, notes, summary
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError, LoadRequest, Step, plan_steps

_AS_BEFORE: Final = "the plate file is as before"


@dataclass(frozen=True)
class Ending:
    """What becomes of the result, and how it is reported."""

    as_json: bool = False
    accept: bool = False
    apply: bool = False  # accept, and have the configuration name the new plate file
    output: Path | None = None  # None: the plate's own file
    valid_days: int = 365
    timeout_s: float = 300.0


def calibrate(config_path: Path, request: LoadRequest, ending: Ending) -> ExitCode:
    """Calibrate a force plate with known masses.

    Raises
    ------
    UserError
        What was asked for, the link, the plate or its loads do not allow it; the plate file is as before.
    """
    return _Calibration(config_path, request, ending).run()


def accept_staged(config_path: Path, *, as_json: bool, apply: bool = False) -> ExitCode:
    """Put a staged calibration into the plate file; with `apply`, have the configuration name that file."""
    session = Session(config_path)
    _accept(session, session.staged_or_refuse(), config_path if apply else None, as_json=as_json)
    return ExitCode.DONE


def abort_staged(config_path: Path, *, as_json: bool) -> ExitCode:
    """Discard what is staged, or was left by an interrupted calibration."""
    session = Session(config_path)
    staged = session.staged()
    if staged is not None:
        remove_remains(Path(staged["output"]))
    session.discard()
    _report(_aborted(staged), f"aborted; {_AS_BEFORE}", as_json=as_json)
    return ExitCode.DONE


class _Calibration:
    """One calibration from the first frame to its result."""

    def __init__(self, config_path: Path, request: LoadRequest, ending: Ending) -> None:
        self._config_path, self._request, self._ending = config_path, request, ending
        self._config = config = load_config(config_path)
        if FORCE_SIGNAL not in config.plate.signals:
            raise ConfigurationError(f"plate {config.plate.name!r} has no force sites; use: resonatord calibrate skin")
        self._steps = plan_steps(request, config.plate)
        self._file = PlateFile.of(config_path, ending.output)
        self._session = session = Session(config_path)
        if session.staged() is not None:
            staged = f"a calibration is staged already ({session.path})"
            raise UsageError(f"{staged}; finish it with --accept-staged or --abort")
        remove_remains(self._file.output)
        self._procedure = LoadProcedure(config.plate, self._steps, ending.timeout_s)
        every_tone = sensor_of(config.plate).expected_tones.pressed_hz is None
        self._loads = MultitoneLoads(config.plate) if every_tone else CapturedLoads(config.plate)
        self._unit = ""
        self._repeated: set[int] = set()

    def run(self) -> ExitCode:
        try:
            with interruptible(_AS_BEFORE), self._session.recording():
                begun = {"plate": str(self._file.source), "sha256": self._file.digest, "wanted": asdict(self._request)}
                self._session.write("begun", begun)
                print_note(f"{len(self._steps)} loads; baseline first: leave the plate untouched")
                outcome = self._capture()
                record = make_record(
                    outcome,
                    calibration_id=secrets.token_hex(8),
                    unit=self._unit,
                    today=datetime.now(UTC).date(),
                    valid_days=self._ending.valid_days,
                )
                staged: dict[str, Any] = {
                    "id": record.calibration.id,
                    "source": str(self._file.source.resolve()),
                    "sha256": self._file.digest,
                    "output": str(self._file.output.resolve()),
                    "record": record.as_json(),
                    "notes": notes(outcome, record),
                    "plate_file": with_record(self._file.source.read_text(encoding="utf-8"), record),
                }
                self._session.write("staged", staged)
        except BaseException as error:
            self._session.discard()
            if isinstance(error, InterruptedCommandError):
                error.partial_result = _aborted(None)
            raise
        for line in [*summary(outcome, record), *(f"note: {note}" for note in staged["notes"])]:
            print_note(line)
        return self._finish(staged)

    def _capture(self) -> Outcome:
        """Lead through all steps; a load that contradicts the others is asked for once more."""
        outcome: Outcome | None = None
        with board_readings(self._config, self._ending.timeout_s) as arrivals:
            for arrival in arrivals:
                if isinstance(arrival, BoardOnline):
                    self._unit = arrival.identity.serial_number
                elif (reading := self._loads.read(arrival)) is not None:
                    for prompt in self._procedure.push(reading):
                        self._show(prompt)
                if self._procedure.done:
                    outcome = self._judge()
                    if self._procedure.done:
                        break
        if outcome is None:
            raise CalibrationRefusedError("the link ended before the calibration did")
        return outcome

    def _fit(self, loads: list[Loading], *, with_response: bool) -> Outcome:
        untouched_hz = self._loads.untouched_hz
        return fit_loadings(
            self._procedure, self._request, loads, with_response=with_response, untouched_hz=untouched_hz
        )

    def _show(self, prompt: Prompt) -> None:
        step = prompt.step
        value: dict[str, Any] = {"event": prompt.event, "step": step.number if step else 0, "steps": len(self._steps)}
        if step is not None:
            value |= {"site": step.site_id, "mass_kg": step.mass_kg, "force_newton": step.force_newton}
            value["kelvin"] = step.kelvin
        text = prompt.text
        if prompt.event == "captured" and step is not None:
            value["residual_newton"], fits = self._partial_fit(step)
            text += fits
            self._session.write("loading", self._captured(step))
        place = f"[{step.number}/{len(self._steps)}] " if step else ""
        _report(value | {"text": prompt.text}, f"{place}{text}", as_json=self._ending.as_json)

    def _captured(self, step: Step) -> dict[str, Any]:
        loading = self._procedure.loadings[step.number]
        return {
            **asdict(step),
            "since_s": loading.since_s,
            "times_s": loading.times_s.tolist(),
            "shift": loading.shift.tolist(),
            "std": loading.std.tolist(),
            "common_mode": self._procedure.untouched.at(float(loading.times_s.mean())).tolist(),
        }

    def _partial_fit(self, step: Step) -> tuple[float | None, str]:
        """Return how far a load lies from the fit of its site, None where that has no meaning; and a text."""
        loads = [load for load in self._procedure.loadings.values() if load.step.site_id == step.site_id]
        if len(loads) < 3 or step.at_temperature:
            return None, ""  # two always fit
        outcome = self._fit(loads, with_response=False)
        residual = outcome.residual_newton[step.number]
        if not abs(residual) <= self._config.plate.force_max_newton:
            return None, "; the loads of this site so far do not fit together"
        text = f"; {1e3 * residual:+.2f} mN from the fit of this site so far"
        return residual, text + (": its loads do not fit together" if find_outliers(outcome) else "")

    def _judge(self) -> Outcome:
        loads = list(self._procedure.loadings.values())
        outcome = self._fit(loads, with_response=self._request.response)
        if outcome.swapped is not None:
            first, second = outcome.swapped
            raise CalibrationRefusedError(
                f"steps {first.number} ({first.load}) and {second.number} ({second.load}): the masses were exchanged, "
                "as what was read fits the other way round; begin again"
            )
        outliers = find_outliers(outcome)
        if outcome.doubtful or outliers:
            self._repeat(outcome, outliers)
        else:
            refuse_unknown_sensitivity(outcome)
        return outcome

    def _repeat(self, outcome: Outcome, outliers: tuple[OutlierSite, ...]) -> None:
        """Ask once more for the loads that do not fit; the second time is one too many."""
        steps = {bad.number: bad for bad in outcome.doubtful}
        steps |= {bad.number: bad for outlier in outliers for bad in outlier.steps}
        finding = "; ".join(
            [
                f"step {bad.number} ({bad.load}) does not fit the others: "
                f"{1e3 * outcome.residual_newton[bad.number]:+.1f} mN off"
                for bad in outcome.doubtful
            ]
            + [outlier.sentence for outlier in outliers]
        )
        if steps.keys() & self._repeated or self._request.response:
            raise CalibrationRefusedError(f"{finding}; check masses and places, and begin again")
        self._repeated |= steps.keys()
        print_note(f"{finding}; once more, please")
        for prompt in self._procedure.repeat([steps[number] for number in sorted(steps)]):
            self._show(prompt)

    def _finish(self, staged: dict[str, Any]) -> ExitCode:
        accept = self._ending.accept or self._ending.apply
        if accept or (sys.stdin.isatty() and _confirmed("accept? [y/N]")):
            target = self._config_path if self._ending.apply else None
            _accept(self._session, staged, target, as_json=self._ending.as_json)
        else:
            line = f"staged, not accepted ({self._session.path}): finish with --accept-staged or --abort"
            _report(_result("staged", staged), line, as_json=self._ending.as_json)
        return ExitCode.DONE


def _accept(session: Session, staged: dict[str, Any], config_path: Path | None, *, as_json: bool) -> None:
    """Write the plate file, and name it in the configuration of this path if one is given."""
    source, output = Path(staged["source"]), Path(staged["output"])
    in_place = output.exists() and output.read_bytes() == staged["plate_file"].encode()  # interrupted after that
    if not in_place and PlateFile(source, output).digest != staged["sha256"]:
        raise CalibrationRefusedError(f"{source} has changed since it was calibrated; --abort, and calibrate again")
    write_plate_file(staged["plate_file"], output)
    session.archive(staged["id"])
    line = f"accepted: calibration {staged['id']} is in {output}"
    if config_path is not None:
        name_plate(config_path, output)
        line += f", which {config_path} now refers to; a running daemon uses it after a restart"
    elif source != output:
        line += f'; set plate = "{output}" in the configuration'
    _report(_result("accepted", staged), line, as_json=as_json)


def _report(value: dict[str, Any], line: str, *, as_json: bool) -> None:
    """Print a line for people and, if wanted, the object."""
    print_note(line)
    if as_json:
        sys.stdout.write(json.dumps(value) + "\n")
        sys.stdout.flush()


def _aborted(staged: dict[str, Any] | None) -> dict[str, Any]:
    """Return the last object of a calibration that is discarded; `staged` is its result, if there was one."""
    return _result("aborted", staged or {}) | {"staged": staged is not None}


def _result(word: str, staged: dict[str, Any]) -> dict[str, Any]:
    """Return the last object of a calibration; null and [] for what there is not."""
    kept = {key: staged.get(key) for key in ("id", "output", "record")}
    return {"verb": "calibrate", "ok": True, "result": word, **kept, "notes": staged.get("notes", [])}


def _confirmed(question: str) -> bool:
    """Return whether the person at the terminal confirms; an answer that is neither yes nor no is asked for again."""
    answer = ""
    try:
        with interruptible(""):
            while answer not in ("y", "yes", "n", "no"):
                sys.stderr.write(f"{question} " if not answer else f"answer y or n; {question} ")
                sys.stderr.flush()
                line = sys.stdin.readline()
                if not line.strip():  # Enter, or the end of the input
                    return False
                answer = line.strip().lower()
    except InterruptedCommandError:  # no answer is no consent, and no reason to lose what was captured
        return False
    return answer.startswith("y")
