"""`resonatord calibrate`: opens the board's link, leads through the steps, and writes the accepted result."""

import json
import secrets
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import ConfigurationError, ExitCode, InterruptedCommandError, UsageError
from resonator_daemon.base.host.signals import interruptible
from resonator_daemon.base.host.text import print_note
from resonator_daemon.base.plate_tables import FORCE_SIGNAL
from resonator_daemon.board.config import load_config
from resonator_daemon.board.recording.event_replay import replay_of
from resonator_daemon.board.session.frames import BoardOnline
from resonator_daemon.measure.pipeline.tone_capture import ToneCapture
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.tools.calibration.load_procedure import LoadProcedure, Prompt
from resonator_daemon.tools.calibration.load_readings import CapturedLoads, MultitoneLoads, board_readings
from resonator_daemon.tools.calibration.outcome import (
    Outcome,
    OutlierSite,
    find_outliers,
    fit_loadings,
    refuse_unknown_sensitivity,
)
from resonator_daemon.tools.calibration.plate_file import PlateFile, name_plate, with_record, write_plate_file
from resonator_daemon.tools.calibration.record import make_record, notes, summary
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError, LoadRequest, plan_steps

_AS_BEFORE: Final = "the plate file is as before"


@dataclass(frozen=True)
class Ending:
    """What becomes of the result, and how it is reported."""

    as_json: bool = False
    accept: bool = False  # without asking; a new plate file needs no consent
    apply: bool = False  # have the configuration name the new plate file
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


class _Calibration:
    """One calibration from the first frame to its result."""

    def __init__(self, config_path: Path, request: LoadRequest, ending: Ending) -> None:
        self._config_path, self._request, self._ending = config_path, request, ending
        self._config = config = load_config(config_path)
        if FORCE_SIGNAL not in config.plate.signals:
            raise ConfigurationError(f"plate {config.plate.name!r} has no force sites; use: resonatord calibrate skin")
        self._steps = plan_steps(request, config.plate)
        self._file = target_of(config_path, ending)
        self._procedure = LoadProcedure(config.plate, self._steps, ending.timeout_s)
        every_tone = sensor_of(config.plate).expected_tones.pressed_hz is None
        self._loads = MultitoneLoads(config.plate) if every_tone else CapturedLoads(config.plate)
        self._unit = ""
        self._repeated: set[int] = set()

    def run(self) -> ExitCode:
        with interruptible(_AS_BEFORE):
            print_note(f"{len(self._steps)} loads; baseline first: leave the plate untouched")
            outcome = self._capture()
        record = make_record(
            outcome,
            calibration_id=secrets.token_hex(8),
            unit=self._unit,
            today=datetime.now(UTC).date(),
            valid_days=self._ending.valid_days,
        )
        remarks = notes(outcome, record)
        for line in [*summary(outcome, record), *(f"note: {remark}" for remark in remarks)]:
            print_note(line)
        result: dict[str, Any] = {"id": record.calibration.id, "record": record.as_json(), "notes": remarks}
        text = with_record(self._file.source.read_text(encoding="utf-8"), record)
        finish(self._config_path, self._file, text, result, self._ending)
        return ExitCode.DONE

    def _capture(self) -> Outcome:
        """Lead through all steps; a load that contradicts the others is asked for once more."""
        outcome: Outcome | None = None
        link, plate = self._config.link, self._config.plate
        with ToneCapture(link, plate, replay=replay_of(link, plate)) as capture:
            for arrival in board_readings(capture, self._ending.timeout_s):
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

    def _show(self, prompt: Prompt) -> None:
        step = prompt.step
        value: dict[str, Any] = {"event": prompt.event, "step": step.number if step else 0, "steps": len(self._steps)}
        if step is not None:
            value |= {"site": step.site_id, "mass_kg": step.mass_kg, "force_newton": step.force_newton}
            value["kelvin"] = step.kelvin
        place = f"[{step.number}/{len(self._steps)}] " if step else ""
        report(value | {"text": prompt.text}, f"{place}{prompt.text}", as_json=self._ending.as_json)

    def _judge(self) -> Outcome:
        loads = list(self._procedure.loadings.values())
        outcome = fit_loadings(
            self._procedure,
            self._request,
            loads,
            with_response=self._request.response,
            untouched_hz=self._loads.untouched_hz,
        )
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


def target_of(config_path: Path, ending: Ending) -> PlateFile:
    """Return the plate file to change; UsageError where nobody could accept it, else as of `PlateFile.of`."""
    file = PlateFile.of(config_path, ending.output)
    if not (ending.accept or file.is_new or sys.stdin.isatty()):
        raise UsageError("give --accept, or a new file with --output: there is no terminal to ask whether to accept")
    return file


def finish(config_path: Path, file: PlateFile, text: str, result: dict[str, Any], ending: Ending) -> None:
    """Write a plate file, if that is accepted, and report the result.

    Raises
    ------
    CalibrationRefusedError
        It is not accepted, or cannot be written; nothing was changed.
    """
    result |= {"output": str(file.output.resolve())}
    if not (ending.accept or file.is_new or _confirmed("accept? [y/n]")):
        raise CalibrationRefusedError(f"not accepted; {_AS_BEFORE}", partial_result=result)
    try:
        write_plate_file(text, file.output)
    except CalibrationRefusedError as error:
        error.partial_result = result
        raise
    line = f"the calibration is in {file.output}"
    if ending.apply:
        name_plate(config_path, file.output)
        line += f", which {config_path} now refers to; a running daemon uses it after a restart"
    elif file.is_new:
        line += f'; set plate = "{file.output}" in the configuration'
    report({"verb": "calibrate", "ok": True, **result}, line, as_json=ending.as_json)


def report(value: dict[str, Any], line: str, *, as_json: bool) -> None:
    """Print a line for people and, if wanted, the object."""
    print_note(line)
    if as_json:
        sys.stdout.write(json.dumps(value) + "\n")
        sys.stdout.flush()


def _confirmed(question: str) -> bool:
    """Return whether the person at the terminal confirms; an answer that is neither yes nor no is asked for again."""
    answer = ""
    try:
        with interruptible(""):
            while answer not in ("y", "yes", "n", "no"):
                sys.stderr.write(f"{question} ")
                sys.stderr.flush()
                line = sys.stdin.readline()
                if not line:  # the end of the input
                    return False
                answer = line.strip().lower()
    except InterruptedCommandError:
        return False
    return answer.startswith("y")
