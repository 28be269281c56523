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
from resonator_daemon.tools.doctor.port_checks import check_port, check_usb_link, usb_device_of

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


def of_usb(host: Host, link: UsbTarget) -> dict[str, Finding]:
    return by_id(check_usb_link(link, host))


def test_a_device_that_is_well_has_nothing_wrong(usb: MadeUpHost) -> None:
    findings = of_usb(usb.host(), UsbTarget(0x1A86, 0x7523, "0042"))
    assert {finding.outcome for finding in findings.values()} == {Outcome.OK}


def test_the_device_behind_a_terminal_is_found(usb: MadeUpHost) -> None:
    device = usb_device_of("ttyUSB0", usb.host())
    assert device == Path("/") / USB
    assert usb_device_of("ttyUSB1", usb.host()) is None


@pytest.mark.parametrize("link", [UsbTarget(0x1A86, 0x7524), UsbTarget(0x1A86, 0x7523, "0043")])
def test_a_device_that_is_not_there_is_a_fault(usb: MadeUpHost, link: UsbTarget) -> None:
    findings = of_usb(usb.host(), link)
    assert findings["usb.device"].outcome is Outcome.FAULT
    assert findings["usb.autosuspend"].outcome is Outcome.NOT_CHECKED


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
