"""Forces on the emulated quartz plate, from its records by eq. (1), and the noise of its oscillators."""

import tomllib

import allantools
import numpy as np
import numpy.typing as npt
import pytest
from plates import plate_head, site
from scenarios import steady

from firmware_protocol.layouts import SINGLE_TONE_STRUCT, RecordFlag, SingleToneRecord
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate, load_plate
from simulators.oscillator_noise import OscillatorNoise
from simulators.physics import Physics
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import Scenario
from simulators.scenario_file import Touch

GATE_TICKS = 1_000_000
PLATE = load_plate("quartz16")
Records = list[list[SingleToneRecord]]


def scenario(*touches: Touch, plate: Plate = PLATE, **physics: float) -> Scenario:
    return Scenario(touches, None, plate, physics=Physics(ideal=True, **physics))


def held(force_newton: float, **place: object) -> Touch:
    return steady(force_newton, start_s=0.1, hold_s=0.5, **place)


def count(plate: QuartzPlate, at_s: float, frames: int, board_ticks: int = 0) -> Records:
    counted = plate.count(board_ticks, round(at_s * 1e9), GATE_TICKS, frames)
    return [[SingleToneRecord(*SINGLE_TONE_STRUCT.unpack(c)) for c in frame.channels] for frame in counted]


def frequency_hz(records: Records, channel: int) -> float:
    """Frequency over all frames, by regression of merged sums in exact integers."""
    n = s1 = s2 = 0
    start = records[0][channel].first_ticks
    for record in (frame[channel] for frame in records):
        d = (record.first_ticks - start) % 2**32
        s2 += record.s2_ticks + n * record.s1_ticks
        s2 += d * (record.stamps * (record.stamps - 1) // 2) + n * record.stamps * d
        s1 += record.s1_ticks + record.stamps * d
        n += record.stamps
    return 1e9 * record.stride_edges * n * (n**2 - 1) / (6 * (2 * s2 - (n - 1) * s1))


def tone_of(site: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    (index,) = np.flatnonzero(PLATE.site_ids[PLATE.tones.site_index] == site)
    return PLATE.tones.f0_hz[index], PLATE.tones.sensitivity[index]


@pytest.mark.parametrize(("site", "force_newton"), [(7, 5.0), (13, 0.2), (4, 8.0), (6, 14.0)])
def test_force_comes_back_through_equation_1(site: int, force_newton: float) -> None:
    plate = QuartzPlate(PLATE, scenario(held(force_newton, site=site), reference_error=-3e-6), seed=1)
    pilot_hz = frequency_hz(count(plate, 0.0, 50), 0)
    assert pilot_hz == pytest.approx(10.01e6 * (1 + 3e-6), abs=0.2)  # a slow reference makes every tone seem high
    records = count(plate, 0.2, 100)
    f0_hz, sensitivity = tone_of(site)
    for channel in range(4):
        true_hz = frequency_hz(records, channel) * 10.01e6 / pilot_hz
        force = (1 - f0_hz[channel] / true_hz) / sensitivity[channel]
        assert force == pytest.approx(force_newton, abs=4e-3)


def test_a_touch_captures_every_corner_once_and_its_release_gives_them_back() -> None:
    plate = QuartzPlate(PLATE, scenario(held(1.0, site=9)), seed=2)
    records = count(plate, 0.09, 530)
    f0_hz, _ = tone_of(9)
    for channel in range(4):
        flags = [frame[channel].flags for frame in records]
        switches = [index for index, flag in enumerate(flags) if flag & RecordFlag.CAPTURE_SWITCH]
        assert switches == [10, 510]
        assert [index for index, flag in enumerate(flags) if flag & RecordFlag.STRIDE_BREAK] == [0, 10, 510]
        assert frequency_hz(records[:10], channel) == pytest.approx(10.01e6, abs=40)
        assert frequency_hz(records[10:510], channel) == pytest.approx(f0_hz[channel], abs=100)
        assert frequency_hz(records[510:], channel) == pytest.approx(10.01e6, abs=40)


@pytest.mark.parametrize("sites", [1, 2, 3])
def test_a_plate_of_few_sites_is_counted_while_all_are_touched(sites: int) -> None:
    counter = {"reference_hz": 1e9, "frame_rate_hz": 1000, "pilot_hz": 10.01e6}
    text = plate_head("few", (-5, -5), (5, 5), **counter) + "".join(
        site(number, number, 0, force=(10e6 - 4000.0 * number, -6e-6)) for number in range(1, sites + 1)
    )
    few = Plate.model_validate(tomllib.loads(text))
    touches = [held(1.0, site=number) for number in range(1, sites + 1)]
    plate = QuartzPlate(few, scenario(*touches, plate=few), seed=2)
    hz = [frequency_hz(count(plate, 0.2, 20), channel) for channel in range(4)]
    pressed_hz = few.tones.f0_hz[:, 0] / (1.0 + 6e-6)
    assert all(np.abs(pressed_hz - each).min() < 60.0 for each in hz)


def overlapping_allan_deviation(shift: Floats, dt_s: float, spans: tuple[int, ...]) -> Floats:
    """Of the mean Allan variance over the oscillators, shift (gates, oscillators)."""
    taus = np.array(spans) * dt_s
    deviations = [allantools.oadev(column, 1 / dt_s, data_type="freq", taus=taus)[1] for column in shift.T]
    return np.sqrt(np.mean(np.square(deviations), axis=0))


@pytest.mark.parametrize("dt_s", [1e-3, 5e-3])
@pytest.mark.parametrize(
    ("levels", "slope"),
    [((1.0, 0.0, 0.0), -0.5), ((0.0, 1.0, 0.0), 0.0), ((0.0, 0.0, 1.0), 0.5)],
    ids=["white", "flicker", "random walk"],
)
def test_allan_deviations_have_their_slope_and_level(
    levels: tuple[float, float, float], slope: float, dt_s: float
) -> None:
    spans = (1, 2, 4, 8, 16, 32, 64, 128, 256)
    shift = OscillatorNoise(48, *levels, np.random.default_rng(1)).advance(dt_s, 2**14).relative_shift
    tau_s = np.array(spans) * dt_s
    deviation = overlapping_allan_deviation(shift, dt_s, spans)
    assert deviation == pytest.approx(tau_s**slope, rel=0.05)
    assert np.polyfit(np.log(tau_s), np.log(deviation), 1)[0] == pytest.approx(slope, abs=0.02)
