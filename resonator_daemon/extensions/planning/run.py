"""Plan of the codes of force sites: their tones, and how often touches would be mistaken."""

import argparse
import math
import sys
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.errors import ExitCode, UsageError, UserError
from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std
from resonator_daemon.extensions.planning import code_placement, code_trials
from resonator_daemon.extensions.planning.code_ladder import GuardBand, force_noise, guard_band, ladder_hz, stamp_noise
from resonator_daemon.extensions.planning.code_plan import BITS_A_BYTE, CodePlan, Trials
from resonator_daemon.extensions.planning.code_trials import Codes, Outcomes, Scatter
from resonator_daemon.extensions.planning.plate_file import (
    PILOT_ABOVE,
    Layout,
    planned_plate,
    plate_file_text,
    plate_layout,
)
from resonator_daemon.extensions.planning.request import JITTER_S, Request, make_request
from resonator_daemon.measure.sensors import plate_sites
from resonator_daemon.measure.sensors.plate_sites import force_sites

COMMON_STD: Final = 2e-7  # of what is left of the common mode, estimated from a pilot
PLATES: Final = 50  # drawn; one where the codes are those of a plate
TWO_TOUCH_SHARE: Final = 20  # of simulated touches, one in this many is two at a time
COMMON_SHIFTS: Final = (1e-5, 2e-5, 4e-5)  # at which the nearest band is tried
CODES_MORE: Final = 1.1  # times as many codes, while neighbours couple too much


class PlanRefusedError(UserError):
    """The plan cannot be fulfilled; no plate file was written."""

    exit_code = ExitCode.FAILED
    code = "no_plan"


@dataclass(frozen=True, eq=False)
class _Ladder:
    """Codes by site, the plate that they make and its file, if it is a new one."""

    codes: NDArray[np.int64]
    step: float
    too_near: tuple[tuple[int, int], ...]
    plate: Plate
    text: str
    refused: tuple[str, ...]


def plan_codes(options: argparse.Namespace) -> tuple[CodePlan, str]:
    """Return the plan, and the text of its plate file.

    Raises
    ------
    UsageError
        The options do not fit together.
    PlanRefusedError
        No plan can fulfil the options; other plans name in `refused` why they do not.
    """
    request = make_request(options)
    random = np.random.default_rng(options.seed)
    guard = guard_band(request.sensitivity * (1.0 + request.spread), request.limits)
    ladder = _kept(request.plate, options) if request.plate else _new(request, guard, options, random)
    plate = ladder.plate
    scatter = _scatter(request, plate, 1e-3 * options.window_ms, options.stamps_per_s)
    typical = float(np.median(np.abs(plate.tones.sensitivity)))
    noise = {
        name: force_noise(typical, scatter.counter_std, 1e-3 * options.window_ms, channels)
        for name, channels in (("one_channel", 1), ("four_channels", CHANNEL_COUNT))
    }
    plates = 1 if request.plate else PLATES
    plan = CodePlan(
        plate=plate,
        codes=ladder.codes,
        step=ladder.step,
        guard=guard,
        too_near=ladder.too_near,
        overlaps=plate_sites.overlaps(plate),
        refused=ladder.refused + _too_slow(plate, options.baud),
        trapped_band=1e-6 * options.band_ppm,
        baud=options.baud,
        window_s=1e-3 * options.window_ms,
        has_pilot=not options.no_pilot,
        noise=noise,
        trials=_trials(plate, scatter, plates, int(options.touches), random),
    )
    return plan, ladder.text


def _new(request: Request, guard: GuardBand, options: argparse.Namespace, random: np.random.Generator) -> _Ladder:
    step, fitting = _step(request, guard, options)
    codes, too_near = _place(request, step, fitting, options, random)
    narrow = step < guard.step * (1.0 - 1e-9)
    f0_hz = np.repeat(ladder_hz(request.f0_hz, step, codes)[:, None], CHANNEL_COUNT, axis=1)
    draft = replace(request.draft, codes_may_overlap=options.accept_overlap)
    text = plate_file_text(request.layout, f0_hz, request.sensitivity, draft)
    plate = planned_plate(text)
    refused: tuple[str, ...] = ()
    if not options.accept_overlap:
        remedy = "raise --step-ppm" if options.step_ppm else "widen --band-ppm, take fewer sites"
        refused = _narrow(plate, codes, step, guard, remedy) if narrow else plate_sites.findings(plate)
    return _Ladder(codes, step, too_near, plate, text, refused)


def _scatter(request: Request, plate: Plate, window_s: float, stamps_per_s: float) -> Scatter:
    limits = request.limits
    return Scatter(
        **vars(limits),
        sensitivity_spread=request.spread,
        tempco_std=request.tempco_std,
        model_error=force_sites(plate).model_error,
        counter_std=stamp_noise(1.0 / plate.counter.reference_hz, JITTER_S, stamps_per_s, window_s),
        oscillator_std=oscillator_std(window_s),
        common_std=COMMON_STD if limits.common_shift == 0 else 0.0,
    )


def _too_slow(plate: Plate, baud: float) -> tuple[str, ...]:
    size, rate_hz = plate.frame_bytes, plate.counter.frame_rate_hz
    needed = size * BITS_A_BYTE * rate_hz
    if needed < baud:
        return ()
    return (
        f"--baud {baud:.0f}: {rate_hz:g} frames/s of {size} bytes need more than {needed:.0f}; raise --baud, or lower "
        "--frame-rate-hz",
    )


def _kept(plate: Plate, options: argparse.Namespace) -> _Ladder:
    """Return a plate's codes, numbered in their order; the step is the least between two tones on one channel."""
    tones = np.log(plate.tones.f0_hz)
    codes = np.empty(len(tones), np.int64)
    codes[np.argsort(-tones.mean(axis=1))] = np.arange(1, len(tones) + 1)
    step = float(np.diff(np.sort(tones, axis=0), axis=0).min()) if len(tones) > 1 else math.nan
    steps = code_placement.needed_steps(code_placement.distances_m(plate.site_positions_m))
    too_near = _by_id(code_placement.missing(codes, steps), plate_layout(plate))
    refused = () if options.accept_overlap else plate_sites.findings(plate)
    return _Ladder(codes, step, too_near, plate, "", refused)


def _step(request: Request, guard: GuardBand, options: argparse.Namespace) -> tuple[float, int]:
    """Return the step, narrowed where the band has no room for it, and how many codes fit."""
    count, room = len(request.layout.site_ids), 1e-6 * options.band_ppm - PILOT_ABOVE - guard.force
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


def _place(
    request: Request, step: float, fitting: int, options: argparse.Namespace, random: np.random.Generator
) -> tuple[NDArray[np.int64], tuple[tuple[int, int], ...]]:
    """Return codes by site, and pairs that couple too much; takes more codes than sites where that helps."""
    layout = request.layout
    distance_m = code_placement.distances_m(layout.positions_m)
    coupling, steps = code_placement.default_coupling(distance_m), code_placement.needed_steps(distance_m)
    if options.coupling is not None:
        coupling = code_placement.measured_coupling_hz(distance_m, *options.coupling)
        steps = code_placement.needed_steps(distance_m, coupling / (step * request.f0_hz))
    code_count = len(layout.site_ids)
    while True:
        codes = code_placement.place_codes(coupling, code_count, steps, random)
        too_near = code_placement.missing(codes, steps)
        if not too_near or code_count == fitting:
            return codes, _by_id(too_near, layout)
        code_count = min(fitting, math.ceil(CODES_MORE * code_count))


def _by_id(pairs: list[tuple[int, int]], layout: Layout) -> tuple[tuple[int, int], ...]:
    return tuple((layout.site_ids[one], layout.site_ids[other]) for one, other in pairs)


def _narrow(plate: Plate, codes: NDArray[np.int64], step: float, guard: GuardBand, remedy: str) -> tuple[str, ...]:
    """Name the two sites whose codes are nearest to each other."""
    if len(codes) < 2:
        return ()
    order = np.argsort(codes)
    steps = np.diff(codes[order])
    nearest = int(np.argmin(steps))
    one, other = sorted(int(plate.site_ids[site]) for site in order[nearest : nearest + 2])
    low, high = plate.thermal.range_kelvin
    return (
        f"sites {one} and {other} can come to be mistaken for each other: their codes are "
        f"{1e6 * step * steps[nearest]:.0f} ppm apart, the guard band is {1e6 * guard.step:.0f} ppm for forces up to "
        f"{plate.force_max_newton:g} N from {low:g} to {high:g} K; {remedy}, lower --force-max-newton or the "
        "tolerances, or insist with --accept-overlap",
    )


def _trials(plate: Plate, scatter: Scatter, plates: int, touches: int, random: np.random.Generator) -> Trials:
    aimed = Codes(plate.tones.f0_hz, plate.tones.sensitivity)
    one, two, overlapping = Outcomes(), Outcomes(), 0
    nearest = dict.fromkeys(COMMON_SHIFTS, 0)
    each = math.ceil(touches / plates)
    for number in range(plates):
        _progress(number, plates)
        drawn = code_trials.draw_plate(aimed, scatter, random)
        overlapping += code_trials.overlaps(drawn, scatter)
        one = one.plus(code_trials.one_touch(drawn, scatter, each, random))
        if len(aimed.f0_hz) > 1:
            two = two.plus(code_trials.two_touches(drawn, scatter, math.ceil(each / TWO_TOUCH_SHARE), random))
        for shift in nearest:
            nearest[shift] += code_trials.nearest_wrong(drawn, scatter.force_max_newton, shift, each, random)
    _progress(plates, plates)
    shares = {shift: count / (each * plates) for shift, count in nearest.items()}
    return Trials(plates, overlapping, one, two, shares)


def _progress(done: int, plates: int) -> None:
    if sys.stderr is not None and sys.stderr.isatty():
        end = "\n" if done == plates else ""
        sys.stderr.write(f"\rsimulated {done} of {plates} plates{end}")
        sys.stderr.flush()
