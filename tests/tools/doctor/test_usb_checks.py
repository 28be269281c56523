"""USB devices on a made-up computer."""

from pathlib import Path

import pytest
from made_up_host import USB, MadeUpHost

from resonator_daemon.board.links.carriers.usb import UsbTarget
from resonator_daemon.tools.doctor.finding import Finding, Outcome
from resonator_daemon.tools.doctor.host_checks import Host
from resonator_daemon.tools.doctor.port_checks import check_usb_device, check_usb_link, usb_device_of

LOAD_BIT_PER_S = 2.04e6


@pytest.fixture
def computer(tmp_path: Path) -> MadeUpHost:
    return MadeUpHost(tmp_path)


def found(host: Host, link: UsbTarget, load_bit_per_s: float = LOAD_BIT_PER_S) -> dict[str, Finding]:
    return {finding.id: finding for finding in check_usb_link(link, host, load_bit_per_s)}


def test_a_device_that_is_well_has_nothing_wrong(computer: MadeUpHost) -> None:
    findings = found(computer.host(), UsbTarget(0x1A86, 0x7523, "0042"))
    assert {finding.outcome for finding in findings.values()} == {Outcome.OK}
    assert findings["usb.hubs"].value == 1.0


def test_the_device_behind_a_terminal_is_found(computer: MadeUpHost) -> None:
    device = usb_device_of("ttyUSB0", computer.host())
    assert device == Path("/") / USB
    assert [finding.id for finding in check_usb_device(device, computer.host(), None)] == [
        "usb.autosuspend",
        "usb.speed",
        "usb.hubs",
    ]
    assert usb_device_of("ttyUSB1", computer.host()) is None


@pytest.mark.parametrize("link", [UsbTarget(0x1A86, 0x7524), UsbTarget(0x1A86, 0x7523, "0043")])
def test_a_device_that_is_not_there_is_a_fault(computer: MadeUpHost, link: UsbTarget) -> None:
    findings = found(computer.host(), link)
    assert findings["usb.device"].outcome is Outcome.FAULT
    assert findings["usb.speed"].outcome is Outcome.NOT_CHECKED


def test_a_device_that_may_not_be_opened_is_a_fault(computer: MadeUpHost) -> None:
    finding = found(computer.host(closed="bus/usb/001/007"), UsbTarget(0x1A86, 0x7523))["usb.device"]
    assert finding.outcome is Outcome.FAULT
    assert "/dev/bus/usb/001/007" in finding.evidence


def test_autosuspend_is_a_warning_unless_its_delay_is_endless(computer: MadeUpHost) -> None:
    link = UsbTarget(0x1A86, 0x7523)
    computer.write(f"{USB}/power/control", "auto")
    computer.write(f"{USB}/power/autosuspend_delay_ms", "2000")
    assert found(computer.host(), link)["usb.autosuspend"].outcome is Outcome.WARNING
    computer.write(f"{USB}/power/autosuspend_delay_ms", "-1000")
    assert found(computer.host(), link)["usb.autosuspend"].outcome is Outcome.OK


@pytest.mark.parametrize(
    ("speed", "load_bit_per_s", "outcome"),
    [
        ("12", 7.1e6, Outcome.OK),
        ("12", 7.3e6, Outcome.FAULT),
        ("480", 100e6, Outcome.OK),
        ("480", 300e6, Outcome.FAULT),
    ],
)
def test_a_speed_that_is_too_low_for_the_frames_is_a_fault(
    computer: MadeUpHost, speed: str, load_bit_per_s: float, outcome: Outcome
) -> None:
    computer.write(f"{USB}/speed", speed)
    assert found(computer.host(), UsbTarget(0x1A86, 0x7523), load_bit_per_s)["usb.speed"].outcome is outcome


def test_many_hubs_in_a_row_are_a_warning(computer: MadeUpHost) -> None:
    findings = check_usb_device(Path("/sys/bus/usb/devices/1-1.4.2.3"), computer.host(), None)
    assert {finding.id: finding.outcome for finding in findings}["usb.hubs"] is Outcome.WARNING
