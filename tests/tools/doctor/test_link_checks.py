"""What a board answers, changed to what a wrong or a broken one would."""

import dataclasses

import pytest
from emulation import emulated
from made_up_host import bad, by_id

from firmware_protocol.messages import Description, Identity, ResetCause
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.session.probe import ProbeResult, TickRate, probe
from resonator_daemon.tools.doctor.finding import Finding, Outcome
from resonator_daemon.tools.doctor.link_checks import check_probe
from simulators.emulator import EmulatorOptions

QUARTZ16 = load_plate("quartz16")
UNCALIBRATED = {"board.unit"}  # what a plate file without a calibration leaves unchecked


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> ProbeResult:
    port = tmp_path_factory.mktemp("asked") / "board"
    with emulated(EmulatorOptions("quartz16", pty=port)):
        link = SerialTarget(str(port), 4_000_000).open()
        try:
            probed = probe(link)
        finally:
            link.close()
    return probed._replace(round_trips_s=(0.001,) * 20, tick_rate=TickRate(2.0, 100.0))


def describing(probed: ProbeResult, **change: object) -> ProbeResult:
    description: Description = dataclasses.replace(probed.described.description, **change)
    return probed._replace(described=probed.described._replace(description=description))


def identifying(probed: ProbeResult, **change: object) -> ProbeResult:
    identity: Identity = dataclasses.replace(probed.described.identity, **change)
    return probed._replace(described=probed.described._replace(identity=identity))


def judged(probed: ProbeResult, plate: Plate | None, busy: str = "") -> dict[str, Finding]:
    return by_id(check_probe(probed, plate, busy))


def test_a_board_that_is_well_has_nothing_wrong(answers: ProbeResult) -> None:
    findings = judged(answers, QUARTZ16)
    assert bad(findings) == {}
    assert {name for name, f in findings.items() if f.outcome is Outcome.NOT_CHECKED} == UNCALIBRATED
    assert judged(answers, None)["board.fits"].outcome is Outcome.NOT_CHECKED


@pytest.mark.parametrize("change", [{"channels": 0}, {"channels": 5}, {"plate": "quartz17"}])
def test_a_board_without_its_channels_or_of_another_plate_does_not_fit(
    answers: ProbeResult, change: dict[str, object]
) -> None:
    assert bad(judged(describing(answers, **change), QUARTZ16)) == {"board.fits": Outcome.FAULT}


def test_a_board_with_which_the_plate_was_not_calibrated_is_a_fault(answers: ProbeResult) -> None:
    for unit, expected in (("EMU-0001", {}), ("EMU-0002", {"board.unit": Outcome.FAULT})):
        record = QUARTZ16.calibration.model_copy(update={"unit": unit})
        assert bad(judged(answers, QUARTZ16.model_copy(update={"calibration": record}))) == expected


@pytest.mark.parametrize(("ppm", "outcome"), [(3000.0, Outcome.FAULT), (-3000.0, Outcome.FAULT), (1050.0, Outcome.OK)])
def test_a_reference_that_must_be_off_is_a_fault(answers: ProbeResult, ppm: float, outcome: Outcome) -> None:
    off = answers._replace(tick_rate=TickRate(ppm, 100.0))
    assert judged(off, QUARTZ16)["board.reference"].outcome is outcome
    assert judged(answers._replace(tick_rate=None), None)["board.reference"].outcome is Outcome.NOT_CHECKED


def test_answers_that_wait_for_a_latency_timer_are_a_warning_unless_this_computer_is_busy(answers: ProbeResult) -> None:
    late = answers._replace(round_trips_s=tuple(0.0005 + 0.016 * step / 20 for step in range(20)))
    waits = judged(late, None)["link.round_trip"]
    assert (waits.outcome, waits.value) == (Outcome.WARNING, pytest.approx(8.3, abs=0.3))  # ms
    assert judged(late, None, "this computer is busy")["link.round_trip"].outcome is Outcome.NOT_CHECKED
    none = answers._replace(round_trips_s=())
    assert bad(judged(none, None, "this computer is busy")) == {"board.pings": Outcome.FAULT}


@pytest.mark.parametrize(
    ("cause", "outcome"),
    [
        (ResetCause.BROWN_OUT, Outcome.WARNING),
        (ResetCause.WATCHDOG, Outcome.WARNING),
        (ResetCause.SOFTWARE, Outcome.OK),
        (250, Outcome.OK),
    ],
)
def test_a_reset_that_nobody_wanted_is_a_warning(answers: ProbeResult, cause: int, outcome: Outcome) -> None:
    assert judged(identifying(answers, reset_cause=cause), None)["board.reset"].outcome is outcome
