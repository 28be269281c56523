"""`resonatord doctor`: checks everything and names who must act."""

import asyncio
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from resonator_daemon.base.entry_points import load_entries
from resonator_daemon.base.errors import ConfigurationError, ExitCode, InterruptedCommandError, UserError
from resonator_daemon.base.host.files import state_directory
from resonator_daemon.base.host.signals import interruptible
from resonator_daemon.base.plate import Plate, load_plate, shipped_plates
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.config import Config, load_config
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.links.port_holders import Holders, port_holders
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.probe import NoBoardError, ProbeResult, probe
from resonator_daemon.tools.doctor import link_checks, sensor_checks
from resonator_daemon.tools.doctor.broker_checks import check_broker
from resonator_daemon.tools.doctor.capture import Capture, capture_board
from resonator_daemon.tools.doctor.daemon_checks import check_daemon, find_daemon
from resonator_daemon.tools.doctor.finding import Area, Check, Finding, Outcome, Report, not_checked
from resonator_daemon.tools.doctor.host_checks import BusyCheck, Host, check_clock, check_disk
from resonator_daemon.tools.doctor.load_check import check_load
from resonator_daemon.tools.doctor.port_checks import (
    HOLDER,
    check_holder,
    check_port,
    check_usb_device,
    check_usb_link,
    usb_device_of,
    usb_node,
)

_DAEMON_HAS_IT: Final = "a daemon has the link; stop it to have the board itself looked at"
_AFTER_OPENING: Final = (*link_checks.OF_A_PROBE, *link_checks.OF_A_CAPTURE, *sensor_checks.OF_THE_PLATE)


@dataclass(frozen=True)
class DoctorOptions:
    """Options of a diagnosis: a configuration's board, or one on a link."""

    config_path: Path | None
    link: LinkTarget | None
    seconds: float
    json: bool = False
    host: Host = field(default_factory=Host)
    load_newton: float | None = None
    verbose: bool = False


def doctor(options: DoctorOptions) -> ExitCode:
    """Check everything, and print the report; FAILED where something is at fault.

    Raises
    ------
    UserError
        Something is at fault, and the report is to be a JSON object.
    ConfigurationError
        The configuration cannot be used: there is nothing to hold the board against.
    InterruptedCommandError
        Ctrl-C came before all was looked at; what was found by then is printed.
    """
    config = None if options.config_path is None else load_config(options.config_path)
    link = options.link or (config.link if config else None)
    if link is not None and link.recording_path is not None:
        raise ConfigurationError(f"link: {link} is a recording, which has no wiring; name the link of a board")
    found: list[Finding] = []
    try:
        with interruptible(""):
            found.extend(_Diagnosis(options, config, link).findings())
    except InterruptedCommandError:
        report = Report(found)
        if found and not options.json:
            report.write(sys.stdout, whole=False, verbose=options.verbose)
        text = f"interrupted after {len(found)} findings; not everything was examined"
        raise InterruptedCommandError(text, partial_result={"findings": report.as_json()["findings"]}) from None
    report = Report(found)
    if not options.json:
        report.write(sys.stdout, verbose=options.verbose)
        return ExitCode.FAILED if report.faulty else ExitCode.DONE
    if report.cause is not None:
        raise UserError(report.verdict_text, partial_result=report.as_json(), code="fault", exit_code=ExitCode.FAILED)
    sys.stdout.write(json.dumps(report.as_json()) + "\n")
    return ExitCode.DONE


class _Diagnosis:
    def __init__(self, options: DoctorOptions, config: Config | None, link: LinkTarget | None) -> None:
        self._options = options
        self._host = options.host
        self._config = config
        self._link = link
        self._captured: Capture | None = None

    def findings(self) -> Iterator[Finding]:
        """Yield everything, each finding as soon as it is known."""
        try:
            yield from self._all()
        finally:
            self._show("")

    def _all(self) -> Iterator[Finding]:
        config = self._config
        if self._link is not None:
            yield from self._board(self._link)
        if config is not None:
            yield _calibration(config.plate)
        self._show("clock, disk")
        yield from check_clock()
        yield from check_disk(state_directory(), config.recording if config else None)
        if config is not None:
            self._show(f"broker {config.mqtt.host}:{config.mqtt.port}")
            yield from asyncio.run(check_broker(config.mqtt, self._host))
            if self._options.load_newton is not None:
                yield asyncio.run(check_load(config, self._options.load_newton))
        for name, check in load_entries("findings", callable):
            self._show(f"extension {name}")
            try:
                found = list(check(config, self._captured))
                if wrong := [each for each in found if not isinstance(each, Finding)]:
                    raise TypeError(f"{wrong[0]!r} is no Finding")
            except Exception as error:  # noqa: BLE001 - code of others, without which the rest is checked
                found = [Check(name, Area.SOFTWARE, f"extension {name}").not_checked(repr(error))]
            yield from found

    def _board(self, link: LinkTarget) -> Iterator[Finding]:
        self._show(f"link {link}")
        node = self._node(link)
        holders = Holders((), True) if node is None else port_holders(str(node))
        of_port = list(self._port(link, holders))
        of_daemon = self._daemon(link, holders)
        if of_daemon:
            yield from (finding for finding in of_port if finding.id != HOLDER.id)
            yield from of_daemon
            reported = {finding.id for finding in of_daemon}
            yield from not_checked((check for check in _AFTER_OPENING if check.id not in reported), _DAEMON_HAS_IT)
            return
        yield from of_port
        if any(finding.outcome is Outcome.FAULT for finding in of_port):
            yield from not_checked((link_checks.OPENS, link_checks.ANSWERS, *_AFTER_OPENING), "the port cannot be used")
            return
        yield from self._probe(link)

    def _daemon(self, link: LinkTarget, holders: Holders) -> list[Finding]:
        """Return the findings on the daemon that has the link; empty where none has it."""
        own_link = self._config is not None and self._config.link == link
        path = self._options.config_path if own_link else None
        answer = asyncio.run(find_daemon(link, path, {holder.pid for holder in holders.processes}))
        return [] if answer is None else list(check_daemon(answer))

    def _node(self, link: LinkTarget) -> Path | None:
        """Return the device file of a link."""
        if link.serial_port is not None:
            return self._host.at(link.serial_port).resolve()
        return usb_node(link.usb_id, self._host) if link.usb_id is not None else None

    def _port(self, link: LinkTarget, holders: Holders) -> Iterator[Finding]:
        if link.serial_port is not None:
            yield from check_port(link.serial_port, self._host, holders)
            name = self._host.at(link.serial_port).resolve().name
            if (device := usb_device_of(name, self._host)) is not None:
                yield check_usb_device(device, self._host)
        elif link.usb_id is not None:
            yield from check_usb_link(link.usb_id, self._host)
            if usb_node(link.usb_id, self._host) is not None:
                yield check_holder(holders, str(link))

    def _probe(self, link: LinkTarget) -> Iterator[Finding]:
        try:
            opened = link.open()
        except LinkUnavailableError as error:
            yield link_checks.OPENS.fault(str(error), link.remedy)
            yield from not_checked((link_checks.ANSWERS, *_AFTER_OPENING), "the link cannot be opened")
            return
        try:
            yield link_checks.OPENS.ok(f"{link} is open")
            self._show("asking the board who it is")
            with BusyCheck(self._host) as busy_check:
                probed = probe(opened)
        except NoBoardError as error:
            if error.refused is not None:
                yield link_checks.MESSAGES.fault(str(error))
            elif error.lost is ReasonCode.PORT_IN_USE:
                yield link_checks.ANSWERS.fault(str(error), "stop the program that is connected to the board")
            else:
                yield (link_checks.RESPONDS if error.is_a_board else link_checks.ANSWERS).fault(str(error))
            yield from not_checked(_AFTER_OPENING, "no board answers")
            return
        finally:
            opened.close()
        yield from self._capture(link, probed, busy_check.reason())

    def _capture(self, link: LinkTarget, probed: ProbeResult, busy: str) -> Iterator[Finding]:
        plate = self._plate(probed)
        answered = list(link_checks.check_probe(probed, plate, busy))
        yield from answered
        faults = {finding.id for finding in answered if finding.outcome is Outcome.FAULT}
        if plate is None or faults & {link_checks.FITS.id, link_checks.PINGS.id}:
            reason = "name a --config FILE" if plate is None else "the board does not serve this plate"
            if link_checks.PINGS.id in faults:
                reason = "frames of a board that answers no ping have no time"
            yield from not_checked((*link_checks.OF_A_CAPTURE, *sensor_checks.OF_THE_PLATE), reason)
            return
        capture = self._captured = capture_board(link, plate, self._options.seconds, self._show, self._host)
        of_link = [finding for finding in link_checks.check_capture(capture) if finding.id not in faults]
        yield from of_link
        if self._config is None:
            yield _calibration(plate)
        if any(finding.outcome is Outcome.FAULT and finding.area is Area.WIRING for finding in of_link):
            reason = "too little arrives undamaged to judge by"
        elif not capture.counted:
            reason = "no frames came"
        elif link_checks.REFERENCE.id in faults:
            reason = "frequencies mean nothing by such a reference"
        else:
            yield from sensor_checks.check_plate(capture, plate)
            return
        yield from not_checked(sensor_checks.OF_THE_PLATE, reason)

    def _plate(self, probed: ProbeResult) -> Plate | None:
        if self._config is not None:
            return self._config.plate
        name = probed.described.description.plate
        return load_plate(name) if name in shipped_plates() else None

    def _show(self, what: str) -> None:
        """Show progress in one line of a terminal."""
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{what}\x1b[K")
            sys.stderr.flush()


def _calibration(plate: Plate) -> Finding:
    return sensor_checks.check_calibration(plate, plate.calibration.expiry_note(datetime.now(UTC).date()))
