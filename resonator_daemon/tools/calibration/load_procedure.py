"""Steps of a calibration: detects in the readings when a load rests, captures it, and prompts for the next."""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.tones.tone_detector import READING_S
from resonator_daemon.tools.calibration.load_readings import NOTHING, PILOT, LoadReading, site_codes
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError, Step

BASELINE_S: Final = 2.0
STEADY_READINGS: Final = 5
STEADY_SHARE: Final = 0.01  # of the force, from the lowest to the highest of these readings; creep stays below it
STEADY_SIGMAS: Final = 8.0
CLEAR_READINGS: Final = 3  # untouched ones between two loads

Kind = Literal["untouched", "place", "wrong_site", "unsteady", "captured", "remove"]


@dataclass(frozen=True)
class Prompt:
    """Instruction or message for the person who loads the plate."""

    event: Kind
    step: Step | None  # None: the untouched baseline
    text: str


@dataclass
class Untouched:
    """Common mode by channel while nothing was touched."""

    times_s: list[float] = field(default_factory=list)
    common_mode: list[Floats] = field(default_factory=list)  # (4,) each
    site_shift: list[Floats] = field(default_factory=list)  # (sites, 4) each, where all sites are measured

    def before(self, time_s: float) -> int:
        """Return which of them is the last one before a time."""
        return max(bisect_left(self.times_s, time_s) - 1, 0)

    def at(self, time_s: float) -> Floats:
        """Return the common mode at a time, between the means before and after it; (4,)."""
        return np.array([np.interp(time_s, self.times_s, channel) for channel in np.transpose(self.common_mode)])


@dataclass(frozen=True)
class Loading:
    """What was captured of one step: readings a tenth of a second apart while the load stood."""

    step: Step
    site: int  # its index
    since_s: float  # when it was placed
    times_s: Floats  # (n,)
    shift: Floats  # (n, 4), 1 - f0 / f with the plate file's f0, the common mode still in it
    std: Floats  # (n, 4), of the counter
    oscillator_std: float  # of each reading, common to its channels
    site_shift: Floats | None  # (sites, 4) of all sites, mean over the readings, where all are measured

    def without_common_mode(self, untouched: Untouched) -> Floats:
        """Return 1 - f0 / f of each reading with the common mode taken out of f; (n, 4)."""
        return 1 - (1 - self.shift) * (1 + untouched.at(float(self.times_s.mean())))


class LoadProcedure:
    """State machine from readings to prompts; `loadings` and `untouched` are what was captured."""

    def __init__(self, plate: Plate, steps: Sequence[Step], timeout_s: float) -> None:
        self.plate = plate
        self._sensitivity = site_codes(plate).sensitivity
        self._site_ids = plate.site_ids.tolist()
        self._timeout_s = timeout_s
        self._steps = deque(steps)
        self.untouched = Untouched()
        self.loadings: dict[int, Loading] = {}  # by number of the step
        self.released_s: list[float] = []  # when each load was taken away
        self._held: deque[LoadReading] = deque()
        self._quiet: list[LoadReading] = []
        self._phase: Literal["baseline", "load", "release", "done"] = "baseline"
        self._captured_newton: float | None = None  # last force captured, where the site was not released since
        self._since_s: float | None = None
        self._problem = ""
        self._placed_s: float | None = None  # when the site was first detected, where it had been released before
        self._announced: set[str] = set()

    @property
    def step(self) -> Step | None:
        """What is to be done now, None for the baseline and at the end."""
        return self._steps[0] if self._phase != "baseline" and self._steps else None

    @property
    def done(self) -> bool:
        """Whether every load was captured, and the last one taken away."""
        return self._phase == "done"

    def repeat(self, steps: Sequence[Step]) -> list[Prompt]:
        """Ask for some steps once more; only when all is done."""
        self._steps.extend(steps)
        self._begin()
        return list(self._ask())

    def push(self, reading: LoadReading) -> list[Prompt]:
        """Process one reading.

        Raises
        ------
        CalibrationRefusedError
            Touched while the baseline is taken; a step that takes too long.
        """
        if self._since_s is None:
            self._since_s = reading.time_s
        if reading.untouched:
            self._quiet.append(reading)
        elif self.untouched.times_s and len(self._quiet) >= CLEAR_READINGS:
            self._keep_quiet()
        else:
            self._quiet.clear()
        prompts: list[Prompt] = []
        match self._phase:
            case "baseline":
                prompts.extend(self._take_baseline(reading))
            case "load":
                prompts.extend(self._await_load(reading, self._steps[0]))
            case "release":
                prompts.extend(self._await_release(reading))
        allowed_s = self._timeout_s + (self.step.hold_s if self.step else BASELINE_S)
        if self._since_s is not None and reading.time_s - self._since_s > allowed_s:
            where = f"step {self._steps[0].number} ({self._steps[0].load})" if self.step else "baseline"
            what = self._problem or "no tone is received"
            raise CalibrationRefusedError(f"{where}: not done within {self._timeout_s:g} s (--timeout-s): {what}")
        return prompts

    def force_newton(self, site: int, shift: Floats, common_mode: Floats) -> Floats:
        """Force by the plate file's sensitivities, mean over the channels; shift (..., 4)."""
        force: Floats = np.mean((shift - common_mode) / self._sensitivity[site], axis=-1)
        return force

    def _take_baseline(self, reading: LoadReading) -> Iterator[Prompt]:
        if reading.touched is not None:
            self._held.append(reading)
            if len(self._held) >= STEADY_READINGS:
                site_id = self._site_ids[reading.touched]
                raise CalibrationRefusedError(
                    f"baseline: site {site_id} is touched; take everything off the plate and begin again"
                )
        else:
            self._held.clear()
        self._problem = _missing(reading, PILOT, "the pilot")
        if len(self._quiet) * READING_S >= BASELINE_S:
            self._keep_quiet()
            self._begin()
            yield Prompt("untouched", None, f"untouched plate captured for {BASELINE_S:g} s")
            yield from self._ask()

    def _await_release(self, reading: LoadReading) -> Iterator[Prompt]:
        self._problem = "the last load was not taken away" if reading.touched is not None else ""
        self._problem = self._problem or _missing(reading, PILOT, "the pilot")
        if len(self._quiet) >= CLEAR_READINGS:
            self.released_s.append(self._quiet[0].time_s - READING_S)
            self._begin()
            yield from self._ask()

    def _begin(self) -> None:
        """Start to wait for a load on the untouched plate."""
        self._keep_quiet()
        self._phase = "load" if self._steps else "done"
        self._captured_newton = self._since_s = self._placed_s = None
        self._held.clear()
        self._announced.clear()

    def _keep_quiet(self) -> None:
        """Append the common mode of the untouched readings so far, as one point."""
        if self._quiet:
            self.untouched.times_s.append(float(np.mean([reading.time_s for reading in self._quiet])))
            self.untouched.common_mode.append(np.mean([reading.pilot_shift for reading in self._quiet], axis=0))
            if site_shift := [reading.site_shift for reading in self._quiet if reading.site_shift is not None]:
                self.untouched.site_shift.append(np.mean(site_shift, axis=0))
            self._quiet = []

    def _ask(self) -> Iterator[Prompt]:
        if not self._steps:
            return
        step = self._steps[0]
        warm = f"bring the plate to {step.kelvin:g} K, then " if step.at_temperature else ""
        replace = " instead of the last mass, without releasing it" if step.continues else ""
        yield Prompt("place", step, f"{warm}place {step.load}{replace}")

    def _await_load(self, reading: LoadReading, step: Step) -> Iterator[Prompt]:
        site = self._site_ids.index(step.site_id)
        if reading.untouched:
            self._await_touch(step)
            return
        if any(tone != site for tone in reading.tone):
            self._held.clear()
            yield from self._report_other_load(reading, site, step)
            return
        if self._captured_newton is None and self._placed_s is None:
            self._placed_s = reading.time_s - READING_S / 2
        self._held.append(reading)
        if len(self._held) < STEADY_READINGS:
            return
        shift = np.array([reading.shift for reading in self._held])
        force = self.force_newton(site, shift, self.untouched.common_mode[-1])
        if not self._steady(force, reading, site, step):
            began = len(self._held) > STEADY_READINGS
            while len(self._held) >= STEADY_READINGS:
                self._held.popleft()
            self._problem = "the load does not stand still"
            if began:
                yield from self._prompt("unsteady", step, f"site {step.site_id}: the load moved; hold it still")
            return
        if self._captured_newton is not None and not self._changed(
            float(np.median(force)) - self._captured_newton, step
        ):
            self._held.popleft()
            self._problem = "the mass was not changed"
            return
        if len(self._held) * READING_S >= step.hold_s - 1e-9:
            yield from self._capture(step, float(np.mean(force)))

    def _steady(self, force: Floats, reading: LoadReading, site: int, step: Step) -> bool:
        """Whether the first forces held agree with each other, and the last one with all."""
        sigma = math.sqrt(reading.oscillator_std**2 + float(np.mean(reading.std**2)) / len(reading.std))
        noise_newton = sigma / float(np.abs(self._sensitivity[site]).mean())
        tolerance = STEADY_SHARE * step.force_newton + STEADY_SIGMAS * noise_newton
        spread = max(np.ptp(force[:STEADY_READINGS]), abs(force[-1] - np.median(force)))
        return bool(spread <= tolerance)

    def _await_touch(self, step: Step) -> None:
        """Untouched while a load is awaited."""
        if self._captured_newton is not None:
            raise CalibrationRefusedError(
                f"step {step.number} ({step.load}): site {step.site_id} was released within its series of loads; "
                "begin again, and change masses while the site stays loaded"
            )
        self._held.clear()
        self._placed_s = None
        if len(self._quiet) * READING_S >= BASELINE_S:
            self._keep_quiet()
        self._problem = "nothing was placed"

    def _changed(self, change_newton: float, step: Step) -> bool:
        """Whether at least half of the step from the mass before has come."""
        return abs(change_newton) > 0.5 * abs(step.force_newton - self.loadings[step.number - 1].step.force_newton)

    def _capture(self, step: Step, force_newton: float) -> Iterator[Prompt]:
        held = list(self._held)
        site_shift = [reading.site_shift for reading in held if reading.site_shift is not None]
        self.loadings[step.number] = Loading(
            step,
            self._site_ids.index(step.site_id),
            self._placed_s if self._placed_s is not None else held[0].time_s - READING_S / 2,
            np.array([reading.time_s for reading in held]),
            np.array([reading.shift for reading in held]),
            np.array([reading.std for reading in held]),
            held[0].oscillator_std,
            np.mean(site_shift, axis=0) if site_shift else None,
        )
        self._captured_newton, self._placed_s = force_newton, None
        self._steps.popleft()
        self._held.clear()
        self._announced.clear()
        self._since_s = None
        off = force_newton - step.force_newton
        text = (
            f"{step.load} captured: {force_newton:.4g} N by the plate file, {off:+.3g} N from {step.force_newton:.4g} N"
        )
        yield Prompt("captured", step, text)
        if self._steps and self._steps[0].continues:
            yield from self._ask()
        else:
            self._phase = "release"
            yield Prompt("remove", step, f"take everything off site {step.site_id}")

    def _report_other_load(self, reading: LoadReading, site: int, step: Step) -> Iterator[Prompt]:
        touched = reading.touched
        if touched is not None and touched != site:
            other = self._site_ids[touched]
            self._problem = f"site {other} carries a load, not site {step.site_id}"
            yield from self._prompt("wrong_site", step, f"{self._problem}; place {step.load}")
        else:
            self._problem = _missing(reading, site, f"site {step.site_id}")

    def _prompt(self, kind: Kind, step: Step, text: str) -> Iterator[Prompt]:
        """Yield each prompt once in a step."""
        if text not in self._announced:
            self._announced.add(text)
            yield Prompt(kind, step, text)


def _missing(reading: LoadReading, wanted: int, name: str) -> str:
    """Return for each channel without the wanted tone what it receives instead."""
    return ", ".join(
        f"channel {channel} {_instead(tone, fault)} instead of {name}"
        for channel, (tone, fault) in enumerate(zip(reading.tone, reading.faults, strict=True))
        if tone != wanted
    )


def _instead(tone: int, fault: str | None) -> str:
    if tone == NOTHING:
        return f"receives no tone ({fault})"
    return "receives the pilot" if tone == PILOT else "receives another site"
