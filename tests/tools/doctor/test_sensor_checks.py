"""Plate and counter: an emulated plate that is well, and its frames changed to what broken ones would send."""

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from emulation import emulated
from made_up_host import bad, by_id

from firmware_protocol.host import PacketRefusal
from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.tools.doctor.capture import Capture, PlateReading, capture_board
from resonator_daemon.tools.doctor.finding import Area, Finding, Outcome, Report
from resonator_daemon.tools.doctor.host_checks import Host
from resonator_daemon.tools.doctor.link_checks import check_capture
from resonator_daemon.tools.doctor.sensor_checks import check_calibration, check_plate
from simulators.emulator import EmulatorOptions

QUARTZ16, COMB16 = load_plate("quartz16"), load_plate("comb16")
SECONDS = 0.6
HOST = Host(Path("/none"))  # which tells of no load


def listened(plate: str = "quartz16", scenario: str = "still", seconds: float = SECONDS) -> Capture:
    """Sit with an emulated board, anew where the computer halted meanwhile: what was seen then is no truth."""
    for _ in range(20):
        with emulated(EmulatorOptions(plate, tcp=("127.0.0.1", 0), scenario=scenario)) as emulator:
            link = parse_link(emulator.link.address)
            capture = capture_board(link, load_plate(plate), seconds, lambda _text: None, HOST)
        if not capture.busy:
            break
    return capture


@pytest.fixture(scope="module")
def calm() -> Capture:
    return listened()


def judged(capture: Capture, plate: Plate) -> dict[str, Finding]:
    return by_id(check_plate(capture, plate))


def changed(capture: Capture, **change: object) -> Capture:
    """Return the capture with each reading changed; a callable is given the reading and its number."""
    readings = [
        dataclasses.replace(
            reading, **{name: value(reading, number) if callable(value) else value for name, value in change.items()}
        )
        for number, reading in enumerate(capture.readings)
    ]
    return dataclasses.replace(capture, readings=readings)


def with_shift(capture: Capture, add: object, tones: object = slice(None), channels: object = slice(None)) -> Capture:
    """Return the capture with this added to the shifts of some tones on some channels; NaN: not counted."""

    def shifted(reading: PlateReading, _number: int) -> np.ndarray:
        shift = reading.shift.copy()
        shift[tones, channels] += add
        return shift

    return changed(capture, shift=shifted)


def test_a_plate_that_is_well_has_nothing_wrong(calm: Capture, comb: Capture) -> None:
    findings = judged(calm, QUARTZ16)
    assert bad(findings) == {}
    assert {finding.outcome for finding in findings.values()} == {Outcome.OK}
    assert {finding.outcome for finding in check_capture(calm)} == {Outcome.OK}
    assert bad(judged(comb, COMB16)) == {}


def test_a_channel_that_hears_nothing_is_dead(calm: Capture) -> None:
    deaf = changed(with_shift(calm, np.nan, channels=2), gates_counted=np.array([1.0, 1.0, 0.0, 1.0]))
    findings = judged(deaf, QUARTZ16)
    assert bad(findings) == {"sensor.channels": Outcome.FAULT}
    assert "channel 2 of 0 to 3" in findings["sensor.channels"].evidence


@pytest.mark.parametrize(("times", "outcome"), [(5.0, Outcome.WARNING), (30.0, Outcome.FAULT)])
def test_a_noise_floor_above_the_counters_own_is_told(calm: Capture, times: float, outcome: Outcome) -> None:
    def noisy(reading: PlateReading, number: int) -> np.ndarray:
        return reading.shift + (-1) ** number * times * reading.std / np.sqrt(2.0)

    assert bad(judged(changed(calm, shift=noisy), QUARTZ16)) == {"sensor.noise": outcome}


@pytest.mark.parametrize(
    ("scatter_radian", "expected"),
    [(0.32, {}), (0.35, {"sensor.noise": Outcome.WARNING}), (1.1, {"sensor.noise": Outcome.FAULT})],
)
def test_edges_that_scatter_more_than_those_of_a_signal_do_are_told(
    calm: Capture, scatter_radian: float, expected: dict[str, Outcome]
) -> None:
    scatter = np.array([0.1, 0.1, scatter_radian, 0.1])
    findings = judged(changed(calm, scatter_radian=scatter), QUARTZ16)
    assert bad(findings) == expected
    assert not expected or "on channel 2" in findings["sensor.noise"].evidence


def test_gates_that_do_not_continue_each_other_are_the_firmwares(calm: Capture) -> None:
    """An edge index that begins again with each gate: each gate has its tone, and no reading has one."""
    nothing = np.full((1, CHANNEL_COUNT), np.nan)
    findings = judged(changed(calm, shift=nothing, std=nothing), QUARTZ16)
    assert bad(findings) == {"board.stamps": Outcome.FAULT}
    silent = judged(changed(calm, shift=nothing, std=nothing, gates_counted=np.zeros(CHANNEL_COUNT)), QUARTZ16)
    assert bad(silent) == {"sensor.channels": Outcome.FAULT}


def test_a_pilot_of_another_plate_is_out_of_place(calm: Capture) -> None:
    strange = changed(calm, shift=np.full((1, CHANNEL_COUNT), np.nan), strange_hz=np.full(CHANNEL_COUNT, 10_046_000.0))
    assert bad(judged(strange, QUARTZ16)) == {"sensor.tones": Outcome.FAULT}


def test_a_plate_that_is_pressed_is_told_whether_it_is_released_or_not(calm: Capture) -> None:
    findings = judged(changed(calm, touched=True), QUARTZ16)
    assert bad(findings) == {"sensor.at_rest": Outcome.FAULT}
    assert findings["sensor.noise"].outcome is Outcome.NOT_CHECKED
    released = changed(calm, touched=lambda _reading, number: number == 0)
    assert bad(judged(released, QUARTZ16)) == {"sensor.at_rest": Outcome.WARNING}
    later = judged(changed(calm, touched=lambda _reading, number: number == 3), QUARTZ16)
    assert bad(later) == {"sensor.at_rest": Outcome.WARNING}
    assert later["sensor.at_rest"].evidence.startswith("touched in 1 of ")


def test_an_expired_calibration_is_a_warning() -> None:
    dated = QUARTZ16.model_copy(update={"calibration": QUARTZ16.calibration.model_copy(update={"id": "abc"})})
    assert check_calibration(QUARTZ16, "").outcome is Outcome.NOT_CHECKED
    assert check_calibration(dated, "").outcome is Outcome.OK
    assert check_calibration(dated, "expired").outcome is Outcome.WARNING


@pytest.fixture(scope="module")
def comb() -> Capture:
    return listened("comb16")


def test_a_tone_that_no_channel_hears_is_a_fault(comb: Capture) -> None:
    findings = judged(with_shift(comb, np.nan, 4), COMB16)
    assert findings["sensor.tones"].outcome is Outcome.FAULT
    assert (findings["sensor.tones"].value, findings["sensor.tones"].limit) == (1.0, 0.0)


def test_a_site_that_stays_pressed_is_a_fault_of_a_calibrated_plate(comb: Capture) -> None:
    pressed = with_shift(comb, 0.1 * COMB16.force_max_newton * COMB16.tones.sensitivity[4], 4)
    dated = COMB16.model_copy(update={"calibration": COMB16.calibration.model_copy(update={"id": "abc"})})
    assert judged(pressed, dated)["sensor.at_rest"].outcome is Outcome.FAULT
    assert judged(pressed, COMB16)["sensor.at_rest"].outcome is Outcome.OK


def test_a_tone_out_of_its_band_is_named(comb: Capture) -> None:
    findings = judged(with_shift(comb, 2e-4, 4), COMB16)
    assert bad(findings) == {"sensor.tones": Outcome.FAULT}
    site = COMB16.site_ids[COMB16.tones.site_index[4]]
    assert f"1 of 16 out of band, the worst is site {site}:" in findings["sensor.tones"].evidence


@pytest.mark.parametrize(
    ("scenario", "id"),
    [
        ("[faults]\nbit_error_rate = 1e-5\n", "link.errors"),
        ('[[faults.events]]\nwhat = "freeze"\nat_s = 0.3\nfor_s = 0.7\n', "link.steady"),
        ("[plate]\ndrop_rate = 0.02\n", "link.overflow"),
        ('[[faults.events]]\nwhat = "unplug"\nat_s = 0.3\nfor_s = 0.1\n', "link.steady"),
    ],
)
def test_what_befalls_the_link_is_told_apart(tmp_path: Path, scenario: str, id: str) -> None:
    (tmp_path / "scenario.toml").write_text(scenario)
    capture = listened(scenario=str(tmp_path / "scenario.toml"), seconds=1.2)
    found = by_id(check_capture(capture))
    assert found[id].outcome is Outcome.FAULT
    assert next(finding.id for finding in found.values() if finding.outcome is Outcome.FAULT) == id


def test_bytes_that_the_driver_lost_are_not_the_cables_fault(calm: Capture) -> None:
    account = dataclasses.replace(
        calm.after, host_overruns=calm.before.host_overruns + 1, bytes_discarded=calm.after.bytes_discarded + 99_999
    )
    found = {finding.id: finding.outcome for finding in check_capture(dataclasses.replace(calm, after=account))}
    assert (found["host.overrun"], found["link.errors"]) == (Outcome.FAULT, Outcome.NOT_CHECKED)


@pytest.mark.parametrize(("busy", "area"), [("", Area.WIRING), ("this computer is busy", Area.SOFTWARE)])
def test_frames_dropped_by_the_board_are_a_finding_on_a_busy_computer(calm: Capture, busy: str, area: Area) -> None:
    lost = dataclasses.replace(calm.after.lost, board_overflow=calm.before.lost.board_overflow + 20)
    capture = dataclasses.replace(calm, busy=busy, after=dataclasses.replace(calm.after, lost=lost))
    found = by_id(check_capture(capture))["link.overflow"]
    assert (found.outcome, found.value, found.area) == (Outcome.FAULT, 20, area)


@pytest.mark.parametrize(
    ("damaged", "discarded", "outcome"),
    [
        (0, 0, Outcome.OK),
        (2, 0, Outcome.WARNING),
        (3, 0, Outcome.FAULT),
        (0, 1024, Outcome.WARNING),
        (0, 1025, Outcome.FAULT),
    ],
)
def test_a_cut_packet_is_no_broken_cable(calm: Capture, damaged: int, discarded: int, outcome: Outcome) -> None:
    lost = dataclasses.replace(calm.after.lost, damaged=calm.before.lost.damaged + damaged)
    counters = dataclasses.replace(calm.after, lost=lost, bytes_discarded=calm.before.bytes_discarded + discarded)
    found = by_id(check_capture(dataclasses.replace(calm, after=counters)))
    assert found["link.errors"].outcome is outcome


def test_frames_that_are_refused_are_named_with_their_code(calm: Capture) -> None:
    refused = PacketRefusal("frame_length", "a frame has 176 bytes, got 175")
    counters = dataclasses.replace(calm.before, refusals=Counter({refused: 900}))
    capture = dataclasses.replace(calm, seconds=0.0, before=counters, after=counters, link="no frames")
    found = by_id(check_capture(capture))
    assert {name for name, finding in found.items() if finding.outcome is Outcome.FAULT} == {"board.frames"}
    assert "frame_length" in found["board.frames"].evidence


def test_a_board_that_does_not_count_is_the_sensors(calm: Capture) -> None:
    silent = dataclasses.replace(calm, seconds=0.0, after=calm.before, link="no frames")
    found = {finding.id: finding.outcome for finding in check_capture(silent)}
    assert {name for name, outcome in found.items() if outcome is Outcome.FAULT} == {"board.counts"}


@pytest.mark.parametrize(
    ("change", "id", "outcome", "cause"),
    [
        ({"interruptions": ["no frame comes"]}, "link.steady", Outcome.NOT_CHECKED, "computer_busy"),
        ({"losses": ["unplugged"]}, "link.steady", Outcome.FAULT, "link.steady"),
        ({"frame_rate_hz": 1e5}, "link.overflow", Outcome.NOT_CHECKED, "computer_busy"),
        ({}, "link.steady", Outcome.OK, None),
    ],
)
def test_what_a_busy_computer_explains_is_not_the_links_fault(
    calm: Capture, change: dict[str, object], id: str, outcome: Outcome, cause: str | None
) -> None:
    busy = dataclasses.replace(calm, busy="this computer is busy", **change)
    report = Report(check_capture(busy))
    assert {finding.id: finding.outcome for finding in report.findings}[id] is outcome
    assert (report.cause.id if report.cause else None) == cause
