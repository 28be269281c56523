"""Output of a calibration: text on stderr, objects for programs on stdout."""

import json
import sys
from collections.abc import Iterator
from typing import Any

from resonator_daemon.base.errors import InterruptedCommandError
from resonator_daemon.base.host.signals import interruptible
from resonator_daemon.base.host.text import print_note
from resonator_daemon.tools.calibration.outcome import Outcome
from resonator_daemon.tools.calibration.plate_file import Record


def report(value: dict[str, Any], line: str, *, as_json: bool) -> None:
    """Print a line for people and, if wanted, the object."""
    print_note(line)
    if as_json:
        sys.stdout.write(json.dumps(value) + "\n")
        sys.stdout.flush()


def aborted(staged: dict[str, Any] | None) -> dict[str, Any]:
    """Return the last object of a calibration that is discarded; `staged` is its result, if there was one."""
    return result("aborted", staged or {}) | {"staged": staged is not None}


def result(word: str, staged: dict[str, Any]) -> dict[str, Any]:
    """Return the last object of a calibration; null and [] for what there is not."""
    kept = {key: staged.get(key) for key in ("id", "output", "record")}
    return {"verb": "calibrate", "ok": True, "result": word, **kept, "notes": staged.get("notes", [])}


def confirmed(question: str) -> bool:
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


def summary(record: Record, outcome: Outcome) -> Iterator[str]:
    """Yield lines on the sites, the whole, and the response."""
    for site, loads_newton in zip(record.sites, outcome.fit.site_residual_newton.tolist(), strict=True):
        sensitivity = ", ".join(f"{value:.4g}" for value in site.sensitivity)
        residual = f"residual {1e3 * loads_newton:.2f} mN rms"
        if outcome.creep_std:
            residual += f" of its loads, {1e3 * site.residual_newton:.2f} mN with the creep that holds do not rule out"
        yield f"site {site.site_id}: K = {sensitivity} 1/N; {residual}"
    yield (
        f"model error {100 * record.model_error:.2g} %, K known to {100 * record.sensitivity_std:.2g} %, "
        f"valid to {record.force_newton[1]:.3g} N, {record.kelvin[0]:g} to {record.kelvin[1]:g} K, "
        f"until {record.expiry}"
    )
    if (response := record.response) is not None:
        yield (
            f"hysteresis {1e3 * response.hysteresis_newton:.1f} mN, creep {100 * response.creep_fraction:.2g} % "
            f"in {response.creep_time_s:.3g} s"
        )
