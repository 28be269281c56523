"""Short runs of the shipped plates: truth, and records of force sites, as of commit 2986582 with the same seed.

Records of skins are those of fields that are tabulated over distance and radius.

A change of the physics, of a draw or of their order changes a digest. Numbers are rounded first, for processors whose
sines differ in their last bit.
"""

import hashlib
import json
import re

import numpy as np
import pytest

from firmware_protocol.layouts import SINGLE_TONE_FIELDS, TONE_FIELDS
from resonator_daemon.base.plate import load_plate
from simulators.board import MadeFrame
from simulators.comb_plate import CombPlate
from simulators.plate import EmulatedPlate, record_type
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import load_scenario
from simulators.skin_plate import SkinPlate
from simulators.truth import truth_line
from simulators.world import World

SEED = 5
QUARTZ_BLOCK = 40  # frames that are counted at once, on which the order of the draws depends
STEPS = {
    "first_ticks": 16, "span_ticks": 16, "s1_ticks": 16, "s2_ticks": 4096, "q2_ticks2": 16, "phase_turn32": 2**24,
    "offset_hz16": 2**16
}  # fmt: skip


def rounded(line: str) -> str:
    """Return the JSON of a line with numbers to 9 digits."""
    decimal = re.compile(r"-?\d+\.\d+(e-?\d+)?")
    return decimal.sub(lambda number: f"{float(number[0]):.9g}", json.dumps(json.loads(line)))


def digests(plate_name: str, scenario_name: str, frames: int) -> tuple[str, str]:
    """Return digests of records and truth of so many frames from the start of a scenario."""
    plate = load_plate(plate_name)
    scenario = load_scenario(scenario_name, plate)
    emulated: EmulatedPlate
    if plate_name == "quartz16":
        emulated = QuartzPlate(plate, scenario, SEED)
    elif plate_name == "comb16":
        emulated = CombPlate(plate, scenario, SEED)
    else:
        emulated = SkinPlate(World(plate), scenario, SEED)
    record = record_type(SINGLE_TONE_FIELDS if plate_name == "quartz16" else TONE_FIELDS)
    gate_ticks = round(plate.counter.reference_hz / plate.counter.frame_rate_hz)
    records, truth = hashlib.sha256(), hashlib.sha256()
    block = QUARTZ_BLOCK if plate_name == "quartz16" else emulated.block_frames
    for first in range(0, frames, block):
        ticks = first * gate_ticks
        for frame in emulated.count(ticks, ticks, gate_ticks, block):
            fields = np.frombuffer(b"".join(frame.channels), record)
            for name in record.names or ():
                records.update(np.rint(fields[name] / STEPS.get(name, 1)).astype("<i8").tobytes())
            line = truth_line(MadeFrame(0, 0, 0, frame.contacts, frame.plate_kelvin), 0)
            truth.update(rounded(line).encode())
    return records.hexdigest()[:16], truth.hexdigest()[:16]


@pytest.mark.parametrize(
    ("plate", "scenario", "frames", "expected"),
    [
        ("quartz16", "touches", 2000, ("644f6125672867b7", "54f97f0b154269f7")),
        ("quartz16", "real", 3200, ("b98f3137e2cc7c8a", "bbd5da51a9da3f06")),
        ("quartz16", "two-touches", 2000, ("7cdd2a2d65d2560f", "e89683ee0300fe23")),
        ("comb16", "real", 800, ("da06542f77a17f01", "ba198b4dc0c6ffcf")),
        ("skin32", "press-and-shear", 200, ("95f9d97fa377b984", "fb66e009791838d4")),
        ("fingertip400", "two-touches", 200, ("e7452f1b1999843b", "0db068b692c82337")),
    ],
)
def test_a_seed_gives_the_frames_and_the_truth_that_it_always_gave(
    plate: str, scenario: str, frames: int, expected: tuple[str, str]
) -> None:
    assert digests(plate, scenario, frames) == expected
