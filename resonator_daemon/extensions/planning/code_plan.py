"""Plan of the codes of force sites: their tones, what they cost, and how often touches would be mistaken."""

import argparse
import math
import sys
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Integers
from resonator_daemon.base.errors import ExitCode, UsageError, UserError
from resonator_daemon.base.plate import Plate
from resonator_daemon.extensions.planning import code_trials
from resonator_daemon.extensions.planning.code_ladder import (
    CodePlacement,
    ForceNoise,
    GuardBand,
    Tolerances,
    force_noise,
    guard_band,
)
from resonator_daemon.extensions.planning.code_trials import Codes, Outcomes
from resonator_daemon.extensions.planning.plate_file import planned_plate, plate_file_text
from resonator_daemon.extensions.planning.request import PILOT_ABOVE, Request, make_request
from resonator_daemon.measure.sensors import plate_sites
from resonator_daemon.tools.view.words import number_table

PLATES: Final = 50  # drawn
TWO_TOUCH_SHARE: Final = 20  # of simulated touches, one in this many is two at a time
CODES_MORE: Final = 1.1  # times as many codes, while neighbours couple too much

_CAUSES: Final = {
    "force": "largest force, all sensitivities",
    "temperature": "temperature coefficients of two sites",
    "ageing": "ageing of two sites",
    "noise": "noise and error of K, odds of 1000 : 1",
    "pulling": "pulling by the corners",
    "placement": "placement of two tones",
}


class PlanRefusedError(UserError):
    """The plan cannot be fulfilled; no plate file was written."""

    exit_code = ExitCode.FAILED
    code = "no_plan"


@dataclass(frozen=True)
class Trials:
    """What a simulation counted."""

    plates_overlapping: int
    one_touch: Outcomes
    two_touches: Outcomes


@dataclass(frozen=True, eq=False)
class CodePlan:
    """Codes of a plate, by site, and all that was found of them; `codes` count from the highest tone, 1."""

    plate: Plate
    plate_file: str
    codes: Integers
    step: float  # relative
    guard: GuardBand
    too_near: list[list[int]]  # sites, by id, whose codes couple too much
    refused: tuple[str, ...]
    trapped_band: float
    window_s: float
    noise: ForceNoise
    trials: Trials

    def as_json(self) -> dict[str, Any]:
        """Everything that is shown."""
        plate, trials = self.plate, self.trials
        tones = plate.tones
        loaded_hz = tones.f0_hz / (1.0 - tones.sensitivity * plate.force_max_newton)
        used_hz = max(plate.pilot_hz, float(loaded_hz.max())) - float(np.minimum(loaded_hz, tones.f0_hz).min())
        return {
            "ok": not self.refused,
            "refused": list(self.refused),
            "plate": plate.name,
            "sites": [
                {
                    "site": site,
                    "position_m": plate.site_positions_m[row].tolist(),
                    "code": int(self.codes[row]),
                    "f0_hz": tones.f0_hz[row].tolist(),
                    "sensitivity": tones.sensitivity[row].tolist(),
                    "at_largest_force_hz": loaded_hz[row].tolist(),
                }
                for row, site in enumerate(plate.site_ids.tolist())
            ],
            "step_ppm": 1e6 * self.step,
            "guard_band_ppm": {cause: 1e6 * share for cause, share in self.guard._asdict().items()}
            | {"step": 1e6 * self.guard.step},
            "neighbours_too_near": self.too_near,
            "band": {
                "pilot_hz": plate.pilot_hz,
                "used_hz": used_hz,
                "used_ppm": 1e6 * used_hz / plate.pilot_hz,
                "trapped_ppm": 1e6 * self.trapped_band,
                "share": used_hz / plate.pilot_hz / self.trapped_band,
            },
            "force_noise": {"window_s": self.window_s} | self.noise._asdict(),
            "trials": {
                "plates": PLATES,
                "plates_overlapping": trials.plates_overlapping,
                "one_touch": trials.one_touch._asdict(),
                "two_touches": trials.two_touches._asdict(),
            },
        }

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        found = self.as_json()
        for table in (self._site_table(found), self._guard_table(), self._trial_table()):
            yield table
            yield ""
        band, noise = found["band"], self.noise
        yield (
            f"Band, from the pilot at {band['pilot_hz']:.1f} Hz down to full load: {band['used_ppm']:.0f} ppm, "
            f"{band['share']:.0%} of {band['trapped_ppm']:.0f} ppm."
        )
        yield (
            f"Noise of a force over {1e3 * self.window_s:g} ms: {1e3 * noise.total_newton:.2g} mN, of the counter "
            f"{1e3 * noise.counter_newton:.2g} mN, of the oscillator {1e3 * noise.oscillator_newton:.2g} mN."
        )
        yield f"Codes overlap on {self.trials.plates_overlapping} of {PLATES} plates drawn."
        if self.too_near:
            pairs = ", ".join(f"{one} and {other}" for one, other in self.too_near)
            yield (
                f"Coupling: the codes of sites {pairs} are too near each other on the ladder; a wider band or sites "
                "further apart would do."
            )

    def _site_table(self, found: dict[str, Any]) -> Table:
        table = number_table("code", "site", "x mm", "y mm", "f0 Hz", "K ppm/N", "at the largest force Hz")
        for site in sorted(found["sites"], key=lambda site: site["code"]):
            x_m, y_m = site["position_m"]
            table.add_row(
                str(site["code"]),
                str(site["site"]),
                f"{1e3 * x_m:.2f}",
                f"{1e3 * y_m:.2f}",
                f"{np.mean(site['f0_hz']):.1f}",
                f"{1e6 * np.mean(site['sensitivity']):.3g}",
                f"{np.mean(site['at_largest_force_hz']):.1f}",
            )
        return table

    def _guard_table(self) -> Table:
        table = number_table("a step must hold", "ppm")
        for cause, share in self.guard._asdict().items():
            table.add_row(_CAUSES[cause], f"{1e6 * share:.1f}")
        table.add_row("together", f"{1e6 * self.guard.step:.1f}")
        table.add_row("step", f"{1e6 * self.step:.1f}")
        return table

    def _trial_table(self) -> Table:
        table = number_table("touches, simulated", "number", "right", "one of two", "wrong", "undecided")
        for name, found in (("one site", self.trials.one_touch), ("two sites", self.trials.two_touches)):
            if found.touches:
                # None of n is below 3 / n, at 95 %.
                shares = [f"{n / found.touches:.2%}" if n else f"0 (< {300 / found.touches:.2g}%)" for n in found]
                table.add_row(name, str(found.touches), *shares)
        return table


def plan_codes(options: argparse.Namespace) -> CodePlan:
    """Return the plan.

    Raises
    ------
    UsageError
        The options do not fit together.
    PlanRefusedError
        No plan can fulfil the options; other plans name in `refused` why they do not.
    """
    request = make_request(options)
    random = np.random.default_rng(options.seed)
    guard = guard_band(request.sensitivity, request.tolerances)
    step, fitting = _step(request, guard, options)
    codes, too_near = _place(request, fitting, random)
    f0_hz = np.repeat(request.f0_hz * (1.0 - step * codes)[:, None], CHANNEL_COUNT, axis=1)
    name = options.output.stem if options.output is not None else "planned"
    text = plate_file_text(name, request, f0_hz, codes_may_overlap=options.accept_overlap)
    plate = planned_plate(text)
    refused: tuple[str, ...] = ()
    if not options.accept_overlap:
        is_narrow = step < guard.step * (1.0 - 1e-9) and len(codes) > 1
        remedy = "raise --step-ppm" if options.step_ppm else "widen --band-ppm, take fewer sites"
        refused = (_narrow(plate, codes, step, guard, remedy),) if is_narrow else plate_sites.findings(plate)
    window_s = 1e-3 * options.window_ms
    typical = float(np.median(np.abs(plate.tones.sensitivity)))
    return CodePlan(
        plate=plate,
        plate_file=text,
        codes=codes,
        step=step,
        guard=guard,
        too_near=too_near,
        refused=refused,
        trapped_band=1e-6 * options.band_ppm,
        window_s=window_s,
        noise=force_noise(typical, request.tolerances.counter_std, window_s, CHANNEL_COUNT),
        trials=_trials(plate, request.tolerances, int(options.touches), random),
    )


def _step(request: Request, guard: GuardBand, options: argparse.Namespace) -> tuple[float, int]:
    """Return the step, narrowed where the band has no room for it, and how many codes fit."""
    count, room = len(request.site_ids), 1e-6 * options.band_ppm - PILOT_ABOVE - guard.force
    if room <= 0:
        raise UsageError(
            f"--band-ppm {options.band_ppm:g}: pilot and largest force alone need "
            f"{1e6 * (PILOT_ABOVE + guard.force):.0f}; widen the band, or lower --force-max-newton"
        )
    step = 1e-6 * (options.step_ppm or math.ceil(1e6 * guard.step))
    fitting = math.floor(room / step + 1e-9)
    if fitting >= count:
        return step, fitting
    if options.step_ppm:
        raise PlanRefusedError(
            f"--step-ppm {options.step_ppm:g}: {count} codes with the pilot need "
            f"{1e6 * (count * step + PILOT_ABOVE + guard.force):.0f} ppm, the trapped band has {options.band_ppm:g}; "
            "lower the step, take fewer sites, or widen --band-ppm"
        )
    return room / count, count


def _place(request: Request, fitting: int, random: np.random.Generator) -> tuple[Integers, list[list[int]]]:
    """Return codes by site, and pairs that couple too much; takes more codes than sites where that helps."""
    placement, code_count = CodePlacement(request.positions_m), len(request.site_ids)
    while True:
        codes = placement.place(code_count, random)
        too_near = placement.too_near(codes)
        if not too_near or code_count == fitting:
            return codes, [[request.site_ids[site] for site in pair] for pair in too_near]
        code_count = min(fitting, math.ceil(CODES_MORE * code_count))


def _narrow(plate: Plate, codes: Integers, step: float, guard: GuardBand, remedy: str) -> str:
    """Name the two sites whose codes are nearest to each other."""
    order = np.argsort(codes)
    steps = np.diff(codes[order])
    nearest = int(np.argmin(steps))
    one, other = sorted(int(plate.site_ids[site]) for site in order[nearest : nearest + 2])
    low, high = plate.thermal.range_kelvin
    return (
        f"sites {one} and {other} can come to be mistaken for each other: their codes are "
        f"{1e6 * step * steps[nearest]:.0f} ppm apart, the guard band is {1e6 * guard.step:.0f} ppm for forces up to "
        f"{plate.force_max_newton:g} N from {low:g} to {high:g} K; {remedy}, lower --force-max-newton or the "
        "tolerances, or insist with --accept-overlap"
    )


def _trials(plate: Plate, tolerances: Tolerances, touches: int, random: np.random.Generator) -> Trials:
    aimed = Codes(plate.tones.f0_hz, plate.tones.sensitivity)
    one, two, overlapping = Outcomes(), Outcomes(), 0
    each = math.ceil(touches / PLATES)
    for number in range(PLATES):
        if sys.stderr is not None and sys.stderr.isatty():
            sys.stderr.write(f"\rsimulating plate {number + 1} of {PLATES}" + "\n" * (number == PLATES - 1))
            sys.stderr.flush()
        drawn = code_trials.draw_plate(aimed, tolerances, random)
        overlapping += code_trials.overlaps(drawn, tolerances)
        one = one.plus(code_trials.one_touch(drawn, tolerances, each, random))
        if len(aimed.f0_hz) > 1:
            two = two.plus(code_trials.two_touches(drawn, tolerances, math.ceil(each / TWO_TOUCH_SHARE), random))
    return Trials(overlapping, one, two)
