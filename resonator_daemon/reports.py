"""Readings to payloads: who measured what when, in the words and units of the MQTT contract."""

import time
from collections import Counter
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, TypedDict

from resonator_daemon.acquisition.clock import Instant
from resonator_daemon.acquisition.frames import BoardOnline
from resonator_daemon.config import Config
from resonator_daemon.decoding.decoded import Decoded as DecodedFrame
from resonator_daemon.measurement import contacts as measured
from resonator_daemon.measurement.chain import ChannelisedReading, SingleToneReading
from resonator_daemon.measurement.matching import SiteForce as MeasuredForce
from resonator_daemon.publishing.payloads import (
    Condition,
    Contact,
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    EventContact,
    Forces,
    Grid,
    Info,
    Lost,
    Signals,
    SiteForce,
    SiteInfo,
    State,
    Status,
)
from resonator_daemon.publishing.topics import (
    CONTACT_EVENT,
    CONTACTS,
    DECODED,
    DECODED_SUMMARY,
    FORCES,
    INFO,
    SIGNALS,
    Topic,
)

_NS = 1_000_000_000


class _Header(TypedDict):
    seq: int
    daemon_boot_id: str
    board_boot_id: str | None
    t_ns: int
    t_unc_ns: int
    lost: Lost


class _Measured(_Header):
    board_ticks: int


class _ContactFields(TypedDict):
    id: int
    site: int
    position_m: tuple[float, float]
    position_std_m: tuple[float, float]
    force_newton: float
    noise_newton: float
    systematic_newton: float
    since_t_ns: int
    status: Status
    at_least_newton: float | None


class Reporter:
    """Makes the messages of one daemon run; numbers those of each topic.

    Parameters
    ----------
    config
        Whose plate and windows the readings belong to.
    daemon_boot_id
        Of this run.
    lost
        Tells the losses as they stand when a message is made.
    """

    def __init__(self, config: Config, daemon_boot_id: str, lost: Callable[[], Lost]) -> None:
        self._config = config
        self._plate = config.plate
        self._daemon_boot_id = daemon_boot_id
        self._lost = lost
        self._seq: Counter[str] = Counter()
        self._since_utc_ns: dict[int, int] = {}  # of the present contacts, by id
        self.board_boot_id: str | None = None

    def header(self, topic: Topic[Any]) -> _Header:
        """Return the header of a message made now."""
        return self._header(topic, Instant(time.time_ns(), 0))

    def state(self, topic: Topic[Any], condition: Condition, reason: str, since_utc_ns: int) -> State:
        return State(**self.header(topic), state=condition, reason=reason, since_t_ns=since_utc_ns)

    def info(self, board: BoardOnline, link: str) -> Info:
        plate, measurement = self._plate, self._config.measurement
        gate_s = 1 / plate.counter.frame_rate_hz
        windowed = plate.counter.kind == "single-tone"
        return Info(
            **self.header(INFO),
            daemon_version=version("resonatord"),
            plate=plate.name,
            link=link,
            serial_number=board.identity.serial_number,
            frame_rate_hz=plate.counter.frame_rate_hz,
            window_s=measurement.window_s if windowed else gate_s,
            step_s=measurement.step_s if windowed else gate_s,
            force_max_newton=plate.force_max_newton,
            outline_m=tuple((float(x), float(y)) for x, y in plate.outline_m),
            sites=tuple(
                SiteInfo(site=int(site), position_m=(float(x), float(y)))
                for site, (x, y) in zip(plate.site_ids, plate.site_positions_m, strict=True)
            ),
        )

    def forces(self, reading: SingleToneReading, gate_end: Instant) -> Forces:
        return Forces(
            **self._measured(FORCES, reading, gate_end),
            window_s=reading.window_s,
            status=Status(reading.status),
            sites=tuple(self._site_force(force) for force in reading.sites),
        )

    def contacts(self, reading: SingleToneReading, gate_end: Instant) -> Contacts:
        return Contacts(
            **self._measured(CONTACTS, reading, gate_end),
            status=Status(reading.status),
            contacts=tuple(Contact(**self._contact(contact, reading, gate_end)) for contact in reading.contacts),
        )

    def event(self, event: measured.ContactEvent, reading: SingleToneReading, gate_end: Instant) -> ContactEvent:
        contact = self._contact(event.contact, reading, gate_end)
        if event.event == "release":
            del self._since_utc_ns[event.contact.id]
        return ContactEvent(
            **self._measured(CONTACT_EVENT, reading, gate_end),
            event=event.event,
            contact=EventContact(**contact, peak_newton=event.contact.peak_newton),
        )

    def signals(self, reading: ChannelisedReading, gate_end: Instant) -> Signals:
        return Signals(**self._measured(SIGNALS, reading, gate_end), signals=reading.signals)

    def decoded(self, reading: ChannelisedReading, gate_end: Instant, frame: DecodedFrame) -> Decoded:
        grid = self._plate.grid
        x, y = self._plate.site_positions_m[0]
        return Decoded(
            **self._measured(DECODED, reading, gate_end),
            traction_pascal=frame.traction_pascal,
            traction_std_pascal=frame.traction_std_pascal,
            displacement_m=frame.displacement_m,
            grid=Grid(origin_m=(float(x), float(y)), pitch_m=grid.pitch_m) if grid else None,
        )

    def summary(
        self, reading: ChannelisedReading, gate_end: Instant, frame: DecodedFrame, decoder: str
    ) -> DecodedSummary:
        return DecodedSummary(
            **self._measured(DECODED_SUMMARY, reading, gate_end),
            decoder=decoder,
            chi2=float(frame.chi2),
            border_contact=bool(frame.border_contact),
            status=Status(str(frame.status)),
        )

    def _header(self, topic: Topic[Any], at: Instant) -> _Header:
        seq = self._seq[topic.path]
        self._seq[topic.path] += 1
        return _Header(
            seq=seq,
            daemon_boot_id=self._daemon_boot_id,
            board_boot_id=self.board_boot_id,
            t_ns=at.utc_ns,
            t_unc_ns=at.uncertainty_ns,
            lost=self._lost(),
        )

    def _measured(
        self, topic: Topic[Any], reading: SingleToneReading | ChannelisedReading, gate_end: Instant
    ) -> _Measured:
        middle = gate_end._replace(utc_ns=gate_end.utc_ns - round(reading.window_s * _NS / 2))
        return _Measured(**self._header(topic, middle), board_ticks=reading.board_ticks)

    def _site_force(self, force: MeasuredForce) -> SiteForce:
        return SiteForce(
            site=int(self._plate.site_ids[force.site]),
            force_newton=force.force_newton,
            noise_newton=force.noise_newton,
            systematic_newton=force.systematic_newton,
            status=Status(force.status),
            at_least_newton=force.at_least_newton,
        )

    def _contact(self, contact: measured.Contact, reading: SingleToneReading, gate_end: Instant) -> _ContactFields:
        if contact.id not in self._since_utc_ns:
            # Once and for all: told anew from the board's nominal rate, it would wander by milliseconds an hour.
            age_s = (reading.board_ticks - contact.since_ticks) / self._plate.counter.reference_hz
            self._since_utc_ns[contact.id] = gate_end.utc_ns - round((age_s + reading.window_s / 2) * _NS)
        return _ContactFields(
            id=contact.id,
            site=int(self._plate.site_ids[contact.site]),
            position_m=contact.position_m,
            position_std_m=contact.position_std_m,
            force_newton=contact.force_newton,
            noise_newton=contact.noise_newton,
            systematic_newton=contact.systematic_newton,
            since_t_ns=self._since_utc_ns[contact.id],
            status=Status(contact.status),
            at_least_newton=contact.at_least_newton,
        )
