"""What a frame costs the chain: shares of its stages, real time used, and growth with the number of sites."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from plate_bench import SETTLED_S, PlateBench

from resonator_daemon.forces.baseline import CommonMode
from resonator_daemon.forces.force_tones import ForceTones
from resonator_daemon.forces.plate_drift import PlateDrift
from resonator_daemon.forces.site_errors import SiteErrors
from resonator_daemon.forces.site_identification import Matcher
from resonator_daemon.forces.spread import SpreadFit
from resonator_daemon.plate import Plate, load_plate
from resonator_daemon.sensors import multitone as comb_chain
from resonator_daemon.sensors import single_tone as single_tone_chain
from resonator_daemon.sensors.multitone_processing import MultitoneProcessing
from resonator_daemon.sensors.single_tone_processing import SingleToneProcessing
from resonator_daemon.tones.few_gates import FewGates
from resonator_daemon.tones.tone_windows import ToneWindows
from simulators.physics import Physics
from simulators.scenario_file import Touch

LADDER_STEP = 400e-6
COMB_SPACING_HZ = 4000.0
COMB_PITCH_MM = 5.0
SENSITIVITY = -6.3e-6
ROUNDS, ROUND_S = 5, 0.1

WHOLE = "whole"
STAGES: dict[str, Sequence[tuple[object, str]]] = {
    WHOLE: ((SingleToneProcessing, "push"), (MultitoneProcessing, "push")),
    "counting": (
        (ToneWindows, "push"),
        (FewGates, "windows"),
        (single_tone_chain, "count_tone"),
        (comb_chain, "merge_tones"),
        (ForceTones, "shifts"),
    ),
    "matching": ((Matcher, "match"),),
    "drift": ((CommonMode, "update"), (PlateDrift, "update")),
    "touches": ((SpreadFit, "fit"),),
    "response": ((SiteErrors, "press"), (SiteErrors, "press_all")),
}


class Cost(NamedTuple):
    """Processor time of a frame, over the time that it lasts and in seconds, and the stages' shares of that."""

    real_time: float
    frame_s: float
    shares: dict[str, float]


def cost(plate: Plate, physics: Physics, *, pressed: bool) -> Cost:
    """Time the chain after it has learnt its baseline: the fastest of some rounds, and the stages' shares of all."""
    site = int(plate.site_ids[len(plate.site_ids) // 2])
    touches = [Touch(start_s=SETTLED_S, site=site, force_newton=1.0, rise_s=0.01, hold_s=1e3)] if pressed else []
    bench = PlateBench(plate, touches, physics=physics)
    for frame in bench.count(SETTLED_S + 0.1):
        bench.push(frame)
    spent = defaultdict[str, float](float)
    rounds_s = []
    for _ in range(ROUNDS):
        frames = list(bench.count(ROUND_S))
        with _timed() as stages:
            for frame in frames:
                bench.push(frame)
        rounds_s.append(stages[WHOLE] / len(frames))
        for stage, seconds in stages.items():
            spent[stage] += seconds
    whole = spent.pop(WHOLE)
    shares = {stage: spent[stage] / whole for stage in STAGES if stage in spent}
    frame_s = min(rounds_s)
    return Cost(frame_s * plate.counter.frame_rate_hz, frame_s, shares | {"rest": 1.0 - sum(shares.values())})


@contextmanager
def _timed() -> Iterator[dict[str, float]]:
    """Processor seconds by stage; of stages within a stage, the inner ones stay part of it."""
    spent = defaultdict[str, float](float)
    inside: list[str] = []

    def watched(stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(*arguments: Any, **options: Any) -> Any:
            if inside and inside[-1] != WHOLE:
                return function(*arguments, **options)
            inside.append(stage)
            start = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                spent[stage] += time.process_time() - start
                inside.pop()

        return call

    with ExitStack() as patches:
        for stage, places in STAGES.items():
            for owner, name in places:
                patches.enter_context(patch.object(owner, name, watched(stage, getattr(owner, name))))
        yield spent


def ladder_plate(sites: int) -> Plate:
    """Return a plate of quartz16's size and counter whose sites lie on a grid and their codes on a ladder."""
    plate = load_plate("quartz16")
    columns = round(sites**0.5)
    places_mm = (np.indices((columns, columns)).reshape(2, -1).T + 0.5) * (20.0 / columns) - 10.0
    f0_hz = 10e6 * np.exp(-LADDER_STEP * (1.0 + np.arange(sites)))
    return Plate.model_validate(
        {
            **plate.model_dump(include={"format", "outline_mm", "transducers_mm", "force_max_newton"}),
            "name": "ladder",
            "counter": {"kind": "single-tone"},
            "sites": _sites(places_mm, f0_hz),
        }
    )


def comb_plate(sites: int) -> Plate:
    """Return a plate of comb16's spread, of sites 5 mm apart."""
    columns = round(sites**0.5)
    half_mm = columns * COMB_PITCH_MM / 2.0
    corners_mm = [[-half_mm, -half_mm], [half_mm, -half_mm], [half_mm, half_mm], [-half_mm, half_mm]]
    places_mm = (np.indices((columns, columns)).reshape(2, -1).T + 0.5) * COMB_PITCH_MM - half_mm
    return Plate.model_validate(
        {
            "format": 1,
            "name": "comb",
            "outline_mm": corners_mm,
            "transducers_mm": corners_mm,
            "force_max_newton": 10.0,
            "spread_width_mm": 2.5,
            "counter": {"kind": "channelised", "frame_rate_hz": 200.0},
            "sites": _sites(places_mm, 10e6 - COMB_SPACING_HZ * (sites - np.arange(sites))),
        }
    )


def _sites(places_mm: np.ndarray[Any, Any], f0_hz: np.ndarray[Any, Any]) -> list[dict[str, Any]]:
    return [
        {
            "id": index + 1,
            "position_mm": place_mm,
            "tones": [{"signal": "force", "f0_hz": [hertz] * 4, "sensitivity": [SENSITIVITY] * 4}],
        }
        for index, (place_mm, hertz) in enumerate(zip(places_mm.tolist(), f0_hz.tolist(), strict=True))
    ]
