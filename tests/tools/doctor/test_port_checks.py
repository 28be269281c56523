"""Serial ports and USB devices, on a made-up computer: each thing that may be wrong, and none where all is well."""

import os
import stat
from pathlib import Path

import pytest
from made_up_host import USB, MadeUpHost, by_id

from resonator_daemon.board.links.carriers.usb import UsbTarget
from resonator_daemon.board.links.port_holders import Holder, Holders
from resonator_daemon.tools.doctor.finding import Finding, Outcome
from resonator_daemon.tools.doctor.host_checks import Host
from resonator_daemon.tools.doctor.port_checks import check_port, check_usb_device, check_usb_link, usb_device_of

PORT = "/dev/ttyUSB0"
NOBODY = Holders((), True)


@pytest.fixture
def computer(tmp_path: Path) -> MadeUpHost:
    made = MadeUpHost(tmp_path)
    port = tmp_path / "dev" / "ttyUSB0"
    try:
        os.mknod(port, stat.S_IFCHR | 0o660, os.makedev(188, 0))
    except PermissionError:
        pytest.skip("device nodes need root")
    os.chmod(port, 0o660)
    return made


def found(host: Host, holders: Holders = NOBODY, port: str = PORT) -> dict[str, Finding]:
    return by_id(check_port(port, host, holders))


def outcomes(findings: dict[str, Finding]) -> set[Outcome]:
    return {finding.outcome for finding in findings.values()}


def test_a_port_that_is_well_has_nothing_wrong(computer: MadeUpHost) -> None:
    assert outcomes(found(computer.host())) == {Outcome.OK}


def test_a_port_that_is_not_there_is_said_with_those_that_are(tmp_path: Path) -> None:
    computer = MadeUpHost(tmp_path)
    computer.link("dev/serial/by-id/usb-RD_board_0042-if00", Path("/dev/null"))
    findings = found(computer.host())
    assert findings["port.exists"].outcome is Outcome.FAULT
    assert "usb-RD_board_0042-if00" in findings["port.exists"].evidence
    assert {finding.outcome for name, finding in findings.items() if name != "port.exists"} == {Outcome.NOT_CHECKED}


def test_a_port_of_another_group_names_the_group(computer: MadeUpHost) -> None:
    os.chown(computer.root / "dev" / "ttyUSB0", 0, 20)  # dialout on Debian
    finding = found(computer.host(closed="ttyUSB0"))["port.permission"]
    assert finding.outcome is Outcome.FAULT
    assert "sudo usermod -aG dialout $USER" in finding.remedy
    os.chmod(computer.root / "dev" / "ttyUSB0", 0o600)
    assert "usermod" not in found(computer.host(closed="ttyUSB0"))["port.permission"].remedy


def test_whoever_holds_the_port_is_named_and_this_process_is_not(computer: MadeUpHost) -> None:
    finding = found(computer.host(), Holders((Holder(77, "minicom", locks=False),), True))["port.holder"]
    assert finding.outcome is Outcome.FAULT
    assert "minicom (pid 77)" in finding.evidence
    own = Holders((Holder(os.getpid(), "pytest", locks=True),), True)
    assert found(computer.host(), own)["port.holder"].outcome is Outcome.OK


def test_modem_manager_is_a_warning_until_a_rule_keeps_it_away(computer: MadeUpHost) -> None:
    computer.write("proc/9/comm", "ModemManager")
    assert found(computer.host())["port.modem_manager"].outcome is Outcome.WARNING
    computer.write("run/udev/data/c188:0", "E:ID_MODEL=x\nE:ID_MM_PORT_IGNORE=0")
    assert found(computer.host())["port.modem_manager"].outcome is Outcome.WARNING
    computer.write("run/udev/data/c188:0", "E:ID_MODEL=x\nE:ID_MM_PORT_IGNORE=1")
    assert found(computer.host())["port.modem_manager"].outcome is Outcome.OK


@pytest.mark.parametrize(
    ("rule", "ids", "outcome"),
    [
        ('ENV{PRODUCT}=="1a86/7523/*", GOTO="brltty"', "1a86 7523", Outcome.WARNING),
        ('# ENV{PRODUCT}=="1a86/7523/*"', "1a86 7523", Outcome.OK),
        ('ENV{PRODUCT}=="403/6001/*"', "1a86 7523", Outcome.OK),
        ('ENV{PRODUCT}=="403/6001/*"', "0403 6001", Outcome.WARNING),
    ],
)
def test_brltty_is_a_warning_where_its_rules_name_the_adapter(
    computer: MadeUpHost, rule: str, ids: str, outcome: Outcome
) -> None:
    for name, text in zip(("idVendor", "idProduct"), ids.split(), strict=True):
        computer.write(f"{USB}/{name}", text)
    computer.write("usr/lib/udev/rules.d/85-brltty.rules", rule)
    assert found(computer.host())["port.brltty"].outcome is outcome


def test_a_latency_timer_is_a_warning_where_it_cannot_be_shortened(computer: MadeUpHost) -> None:
    (computer.root / f"{USB}/1-1.4:1.0/ttyUSB0/latency_timer").unlink()
    assert found(computer.host())["port.latency_timer"].outcome is Outcome.OK
    computer.write(f"{USB}/1-1.4:1.0/ttyUSB0/latency_timer", "16")
    assert found(computer.host())["port.latency_timer"].outcome is Outcome.OK
    finding = found(computer.host(closed="latency_timer"))["port.latency_timer"]
    assert (finding.outcome, finding.value, finding.limit) == (Outcome.WARNING, 16.0, 1.0)


@pytest.fixture
def usb(tmp_path: Path) -> MadeUpHost:
    """A computer whose port needs no device node."""
    return MadeUpHost(tmp_path)


LOAD_BIT_PER_S = 2.04e6


def of_usb(host: Host, link: UsbTarget, load_bit_per_s: float = LOAD_BIT_PER_S) -> dict[str, Finding]:
    return by_id(check_usb_link(link, host, load_bit_per_s))


def test_a_device_that_is_well_has_nothing_wrong(usb: MadeUpHost) -> None:
    findings = of_usb(usb.host(), UsbTarget(0x1A86, 0x7523, "0042"))
    assert {finding.outcome for finding in findings.values()} == {Outcome.OK}
    assert findings["usb.hubs"].value == 1.0


def test_the_device_behind_a_terminal_is_found(usb: MadeUpHost) -> None:
    device = usb_device_of("ttyUSB0", usb.host())
    assert device == Path("/") / USB
    assert [finding.id for finding in check_usb_device(device, usb.host(), None)] == [
        "usb.autosuspend",
        "usb.speed",
        "usb.hubs",
    ]
    assert usb_device_of("ttyUSB1", usb.host()) is None


@pytest.mark.parametrize("link", [UsbTarget(0x1A86, 0x7524), UsbTarget(0x1A86, 0x7523, "0043")])
def test_a_device_that_is_not_there_is_a_fault(usb: MadeUpHost, link: UsbTarget) -> None:
    findings = of_usb(usb.host(), link)
    assert findings["usb.device"].outcome is Outcome.FAULT
    assert findings["usb.speed"].outcome is Outcome.NOT_CHECKED


def test_a_device_that_may_not_be_opened_is_a_fault(usb: MadeUpHost) -> None:
    finding = of_usb(usb.host(closed="bus/usb/001/007"), UsbTarget(0x1A86, 0x7523))["usb.device"]
    assert finding.outcome is Outcome.FAULT
    assert "/dev/bus/usb/001/007" in finding.evidence


def test_autosuspend_is_a_warning_unless_its_delay_is_endless(usb: MadeUpHost) -> None:
    link = UsbTarget(0x1A86, 0x7523)
    usb.write(f"{USB}/power/control", "auto")
    usb.write(f"{USB}/power/autosuspend_delay_ms", "2000")
    assert of_usb(usb.host(), link)["usb.autosuspend"].outcome is Outcome.WARNING
    usb.write(f"{USB}/power/autosuspend_delay_ms", "-1000")
    assert of_usb(usb.host(), link)["usb.autosuspend"].outcome is Outcome.OK


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
    usb: MadeUpHost, speed: str, load_bit_per_s: float, outcome: Outcome
) -> None:
    usb.write(f"{USB}/speed", speed)
    assert of_usb(usb.host(), UsbTarget(0x1A86, 0x7523), load_bit_per_s)["usb.speed"].outcome is outcome


def test_many_hubs_in_a_row_are_a_warning(usb: MadeUpHost) -> None:
    findings = check_usb_device(Path("/sys/bus/usb/devices/1-1.4.2.3"), usb.host(), None)
    assert {finding.id: finding.outcome for finding in findings}["usb.hubs"] is Outcome.WARNING
