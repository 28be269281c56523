"""Masses that a script lays on an emulated plate, at the plate's own time: no link, no clock."""

import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT, TONE_FIELDS, single_tone_records
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.estimate.tones.tone_detector import reading_frames
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.tools.calibration.load_procedure import LoadProcedure, Prompt
from resonator_daemon.tools.calibration.load_readings import CapturedLoads, LoadReading, MultitoneLoads
from resonator_daemon.tools.calibration.outcome import Outcome, fit_loadings
from resonator_daemon.tools.calibration.steps import STANDARD_GRAVITY, LoadRequest, Step
from simulators.comb_plate import CombPlate
from simulators.plate import record_type
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import load_scenario
from simulators.tone_records import even_oscillators

PLATES = Path(__file__).parents[3] / "resonator_daemon/base/plates"
SHIPPED, COMB = PLATES / "quartz16.toml", PLATES / "comb16.toml"
TONE = record_type(TONE_FIELDS)
BASELINE_S = 3.0
MARGIN_S = 0.8  # of each load's time on the plate over its hold
GAP_S = 0.8  # between loads
RAMP_S = 0.2
IDEAL = "[plate]\nideal = true\n"


@dataclass
class Touches:
    """A scenario file in the making."""

    physics: str = IDEAL
    seconds: float = BASELINE_S
    lines: list[str] = field(default_factory=list)

    def press(self, site_id: int, newton: float, start_s: float, hold_s: float) -> None:
        self.lines.append(
            f"[[touches]]\nstart_s = {start_s:.3f}\nsite = {site_id}\nforce_newton = {newton!r}\n"
            f"rise_s = {RAMP_S}\nhold_s = {hold_s:.3f}\nfall_s = {RAMP_S}\n"
        )
        self.seconds = max(self.seconds, start_s + hold_s + 2 * RAMP_S + GAP_S)

    def load(self, site_id: int, mass_kg: float, hold_s: float) -> None:
        """Lay a mass on a site, after everything that came before."""
        self.press(site_id, mass_kg * STANDARD_GRAVITY, self.seconds, hold_s + MARGIN_S)

    def follow(self, steps: Iterable[Step], masses: dict[float, float] | None = None) -> None:
        """Do what a calibration will ask for; `masses` tells what a nominal mass really weighs."""
        for step in steps:
            newton = (masses or {}).get(step.mass_kg, step.mass_kg) * STANDARD_GRAVITY
            # One mass takes over from the other while both ramps run: the load goes straight from one to the other.
            start_s = self.seconds - GAP_S - RAMP_S if step.continues else self.seconds
            self.press(step.site_id, newton, start_s, step.hold_s + MARGIN_S)

    def write(self, folder: Path) -> str:
        path = folder / "loads.toml"
        path.write_text(self.physics + "\n" + "\n".join(self.lines))
        return str(path)


def nominal_text() -> str:
    """quartz16 as its plate file says, with ten times fewer and longer gates, which cost less to count."""
    return SHIPPED.read_text().replace("frame_rate_hz = 1000", "frame_rate_hz = 100")


def comb_text() -> str:
    """comb16 as its plate file says, with longer gates."""
    return COMB.read_text().replace("frame_rate_hz = 200", "frame_rate_hz = 50")


def true_text(text: str | None = None, seed: int = 5) -> str:
    """Return the plate file as the plate really is: each K up to 25 % and each f0 up to 20 ppm from what it says."""
    random = np.random.default_rng(seed)

    def off(match: re.Match[str]) -> str:
        values = np.array([float(value) for value in match[2].split(",")])
        share = random.uniform(-0.25, 0.25) if match[1] == "sensitivity" else random.uniform(-20e-6, 20e-6, 4)
        return f"{match[1]} = [{', '.join(repr(float(value)) for value in values * (1 + share))}]"

    return re.sub(r"(f0_hz|sensitivity) = \[(.*)\]", off, text or nominal_text())


NOMINAL = Plate.model_validate(tomllib.loads(nominal_text()))
TRUE = Plate.model_validate(tomllib.loads(true_text()))
COMB_NOMINAL = Plate.model_validate(tomllib.loads(comb_text()))
COMB_TRUE = Plate.model_validate(tomllib.loads(true_text(comb_text())))


def frames(plate: Plate, touches: Touches, folder: Path, seed: int = 1) -> Iterator[tuple[int, bytes]]:
    """Count the plate, frame after frame."""
    scenario = load_scenario(touches.write(folder), plate)
    emulated = QuartzPlate(plate, scenario, seed)
    gate_ticks = round(plate.counter.reference_hz / plate.counter.frame_rate_hz)
    emulated.start()
    index = 0
    while index * gate_ticks < touches.seconds * plate.counter.reference_hz:
        for frame in emulated.count(index * gate_ticks, index * gate_ticks, gate_ticks, emulated.block_frames):
            yield index, b"".join(frame.channels)
            index += 1


def comb_frames(plate: Plate, touches: Touches, folder: Path, seed: int = 1) -> Iterator[tuple[Any, ...]]:
    """Count a channelised plate, frame after frame: index, phases, offsets, sigma codes and what is known."""
    emulated = CombPlate(plate, load_scenario(touches.write(folder), plate), seed)
    gate_ticks = round(plate.counter.reference_hz / plate.counter.frame_rate_hz)
    known = np.ones((CHANNEL_COUNT, len(plate.tones.f0_hz)), dtype=bool)
    index = 0
    while index * gate_ticks < touches.seconds * plate.counter.reference_hz:
        for frame in emulated.count(index * gate_ticks, index * gate_ticks, gate_ticks, emulated.block_frames):
            tones = np.array([np.frombuffer(channel, TONE) for channel in frame.channels])
            yield index, tones["phase_turn32"], tones["offset_hz16"], tones["sigma_code"], known
            index += 1


class Loads:
    """Tone detector of a board, and what its readings say about the loads of a plate."""

    def __init__(self, plate: Plate, true: Plate) -> None:
        sensor = sensor_of(plate)
        frames = reading_frames(1 / plate.counter.frame_rate_hz)
        every_tone = sensor.expected_tones.pressed_hz is None
        self._detector = sensor.tone_detector(frames, even_oscillators(true)[0] if every_tone else np.zeros(0))
        self._loads = MultitoneLoads(plate) if every_tone else CapturedLoads(plate)

    @property
    def untouched_hz(self) -> Floats | None:
        return self._loads.untouched_hz

    def push(self, index: int, *counted: Any) -> LoadReading | None:
        """Add a frame: its payload, or its phases, offsets, sigma codes and what is known."""
        frame: Any
        if len(counted) == 1:
            frame = SimpleNamespace(index=index, payload=counted[0], records=single_tone_records(counted[0]))
        else:
            names = ("phase_turn32", "offset_hz16", "sigma_code", "known")
            frame = SimpleNamespace(index=index, **dict(zip(names, counted, strict=True)))
        reading = self._detector.push(frame)
        return None if reading is None else self._loads.read(reading)


def fitted(procedure: LoadProcedure, wanted: LoadRequest, loads: Loads | None = None) -> Outcome:
    """Fit everything that the procedure has captured."""
    captured, untouched_hz = list(procedure.loadings.values()), None if loads is None else loads.untouched_hz
    return fit_loadings(procedure, wanted, captured, with_response=wanted.response, untouched_hz=untouched_hz)


def lead(
    procedure: LoadProcedure, plate: Plate, counted: Iterable[tuple[Any, ...]], loads: Loads | None = None
) -> Iterator[Prompt]:
    """Give the procedure the readings of frames until it is done; `plate` is what the procedure assumes."""
    loads = loads or Loads(plate, plate)
    for frame in counted:
        if (reading := loads.push(*frame)) is not None:
            yield from procedure.push(reading)
            if procedure.done:
                return
