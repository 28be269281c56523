"""Readings to payloads: who measured what when, in the words and units of the MQTT contract."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from datetime import date
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.config import Config
from resonator_daemon.forces import contacts as measured
from resonator_daemon.forces.readings import Compensation as MeasuredCompensation
from resonator_daemon.forces.readings import ForceReading, SkinReading
from resonator_daemon.forces.site_identification import SiteForce as MeasuredForce
from resonator_daemon.monitoring.daemon_state import DaemonStanding
from resonator_daemon.pipeline.surface_reports import ContactFields, HeaderFields, MeasuredFields
from resonator_daemon.pipeline.surface_stream import SurfaceFrame
from resonator_daemon.publishing.payloads import (
    CalibrationInfo,
    Compensation,
    Condition,
    Contact,
    ContactEvent,
    Contacts,
    EventContact,
    Forces,
    GridInfo,
    Info,
    Lost,
    OutageInfo,
    Signals,
    SiteForce,
    SiteInfo,
    SkinInfo,
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
    SCHEMA_VERSION,
    SIGNALS,
    STATE_DAEMON,
    STATE_LINK,
    STATE_SENSOR,
    Topic,
)
from resonator_daemon.publishing.units import UNITS
from resonator_daemon.publishing.verbs import obeyed
from resonator_daemon.session.clock import Instant
from resonator_daemon.session.frames import BoardOnline, LinkChange, Outage

_NS = 1_000_000_000
_DAY_NS = 86_400 * _NS
_EPOCH_DAY = date(1970, 1, 1).toordinal()
_STATUS = {str(word): word for word in Status}


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
        self._gate_s = 1 / self._plate.counter.frame_rate_hz
        self._site_numbers: list[int] = self._plate.site_ids.tolist()
        self._daemon_boot_id = daemon_boot_id
        self.measurement = config.measurement
        self.allowed: Collection[str] = config.commands.allow
        self.lost = lost
        self._seq: Counter[str] = Counter()
        self._since_utc_ns: dict[int, int] = {}  # of the present contacts on force sites, by id
        self.board_boot_id: str | None = None

    def header(self, topic: Topic[Any], utc_ns: int) -> HeaderFields:
        """Return the header of a message that tells of a moment on the host's clock."""
        return {
            "seq": self._next_seq(topic),
            "daemon_boot_id": self._daemon_boot_id,
            "board_boot_id": self.board_boot_id,
            "t_ns": utc_ns,
            "t_unc_ns": 0,
            "lost": self.lost(),
        }

    def skip(self, *topics: Topic[Any]) -> None:
        """Skip one number `seq` of each topic, for a message that is not made."""
        for topic in topics:
            self._seq[topic.path] += 1

    def daemon_state(self, standing: DaemonStanding, utc_ns: int) -> State:
        return State(
            **self.header(STATE_DAEMON, utc_ns),
            state=standing.condition,
            reason=standing.reason,
            since_t_ns=standing.since_utc_ns,
            connections=standing.connections,
            connected_t_ns=standing.connected_utc_ns,
        )

    def link_state(self, link: LinkChange, outage: Outage | None, boots: int) -> State:
        """Return the link's state, with its last outage and the boots of the board that were seen on it."""
        told = None
        if outage is not None:
            told = OutageInfo(
                start_t_ns=outage.start_utc_ns,
                end_t_ns=outage.end_utc_ns,
                frames_lost=outage.frames_lost,
                reason=outage.reason,
            )
        return State(
            **self.header(STATE_LINK, link.utc_ns),
            state=Condition(link.state),
            reason=link.reason,
            since_t_ns=link.since_utc_ns,
            last_outage=told,
            boots=boots,
        )

    def sensor_state(self, condition: Condition, reason: str, since_utc_ns: int, utc_ns: int) -> State:
        return State(**self.header(STATE_SENSOR, utc_ns), state=condition, reason=reason, since_t_ns=since_utc_ns)

    def info(self, board: BoardOnline, limits_hz: Mapping[str, float], utc_ns: int) -> Info:
        """Return what the plate is; `limits_hz` are rates of topics that were lowered by a command."""
        plate = self._plate
        gate_s = 1 / plate.counter.frame_rate_hz
        windowed = plate.skin is None
        return Info(
            **self.header(INFO, utc_ns),
            schema_version=SCHEMA_VERSION,
            daemon_version=version("resonatord"),
            plate=plate.name,
            link=str(self._config.link),
            product=board.identity.product,
            serial_number=board.identity.serial_number,
            firmware=board.identity.firmware,
            counter=plate.counter.kind,
            frame_rate_hz=plate.counter.frame_rate_hz,
            window_s=self.measurement.window_s if windowed else gate_s,
            step_s=self.measurement.step_s if windowed else gate_s,
            rates_hz=self._rates_hz(limits_hz),
            units=UNITS,
            commands=obeyed(self.allowed),
            force_max_newton=plate.force_max_newton,
            outline_m=_pairs(plate.outline_m),
            transducers_m=_pairs(plate.transducers_m),
            sites=tuple(
                SiteInfo(site=int(site), position_m=position)
                for site, position in zip(plate.site_ids, _pairs(plate.site_positions_m), strict=True)
            ),
            grid=self._grid(),
            skin=self._skin(),
            calibration=self._calibration(),
        )

    @property
    def streams(self) -> tuple[str, ...]:
        """Paths of the topics that come by themselves, their decimated copies aside."""
        return tuple(topic.path for topic in self._streams())

    def _streams(self) -> tuple[Topic[Any], ...]:
        if self._plate.skin is None:
            return FORCES, CONTACTS
        in_daemon = self._config.decoding.method != "off" and not self._config.decoding.apart
        return (SIGNALS, DECODED, DECODED_SUMMARY, CONTACTS) if in_daemon else (SIGNALS,)

    def _rates_hz(self, limits_hz: Mapping[str, float]) -> dict[str, float]:
        counter, windowed = self._plate.counter, self._plate.skin is None
        rate_hz = 1 / self.measurement.step_s if windowed else counter.frame_rate_hz
        rates_hz = {}
        for topic in self._streams():
            rates_hz[topic.path] = min(rate_hz, limits_hz.get(topic.path, rate_hz))
            if topic.slow_hz is not None:
                rates_hz[topic.slow_path] = min(rate_hz, topic.slow_hz)
        return rates_hz

    def _grid(self) -> GridInfo | None:
        grid = self._plate.grid
        if grid is None:
            return None
        origin_m, *_ = _pairs(self._plate.site_positions_m)
        return GridInfo(origin_m=origin_m, pitch_m=grid.pitch_m, shape=grid.shape)

    def _skin(self) -> SkinInfo | None:
        skin = self._plate.skin
        if skin is None:
            return None
        return SkinInfo(
            youngs_modulus_pascal=skin.youngs_modulus_pascal,
            poisson_ratio=skin.poisson_ratio,
            depth_m=skin.depth_m,
            gain_std=skin.gain_std,
            correlation_length_m=skin.correlation_length_m,
            tangential_ratio=skin.tangential_ratio,
        )

    def forces(self, reading: ForceReading, gate_middle: Instant) -> Forces:
        return Forces(
            **self._measured(FORCES, reading, gate_middle),
            window_s=reading.window_s,
            status=_STATUS[reading.status],
            reason=reading.reason,
            sites=tuple([self._site_force(force, gate_middle) for force in reading.sites]),
            beats=reading.beats,
            compensation=_compensation(reading.compensation),
        )

    def contacts(self, reading: ForceReading, gate_middle: Instant) -> Contacts:
        return Contacts(
            **self._measured(CONTACTS, reading, gate_middle),
            status=_STATUS[reading.status],
            reason=reading.reason,
            contacts=tuple([Contact(**self._contact(contact, reading, gate_middle)) for contact in reading.contacts]),
        )

    def event(self, event: measured.ContactEvent, reading: ForceReading, gate_middle: Instant) -> ContactEvent:
        contact = self._contact(event.contact, reading, gate_middle)
        if event.event == "release":
            del self._since_utc_ns[event.contact.id]
        return ContactEvent(
            **self._measured(CONTACT_EVENT, reading, gate_middle),
            event=event.event,
            reason=event.reason,
            contact=EventContact(**contact),
        )

    def signals(self, reading: SkinReading, gate_middle: Instant) -> Signals:
        return Signals(
            **self._measured(SIGNALS, reading, gate_middle),
            signals=reading.signals,
            noise_std=reading.noise_std,
            status=_STATUS[reading.status],
        )

    def surface_frame(self, reading: SkinReading, gate_middle: Instant) -> SurfaceFrame:
        """Return a frame to be decoded, with its numbers `seq`: if it is skipped, they are missing."""
        header = self._measured(DECODED, reading, gate_middle)
        return SurfaceFrame(header, self._next_seq(CONTACTS), reading.signals, reading.noise_std)

    def contacts_header(self, reading: SkinReading, gate_middle: Instant) -> MeasuredFields:
        """Return the header of a message on `contacts` that belongs to no frame."""
        return self._measured(CONTACTS, reading, gate_middle)

    def numbered(self, event: ContactEvent) -> ContactEvent:
        """Return an event of the surface with the next number `seq` of all events."""
        return event.model_copy(update={"seq": self._next_seq(CONTACT_EVENT)})

    def _calibration(self) -> CalibrationInfo:
        calibration = self._plate.calibration
        return CalibrationInfo(
            id=calibration.id,
            date=calibration.date.isoformat() if calibration.date else None,
            unit=calibration.unit,
            expiry=calibration.expiry.isoformat() if calibration.expiry else None,
            model_error=calibration.model_error,
            sensitivity_std=calibration.sensitivity_std,
            response="on" if self._plate.response else "off",
        )

    def _next_seq(self, topic: Topic[Any]) -> int:
        path = topic.path
        seq = self._seq[path]
        self._seq[path] = seq + 1
        return seq

    def _measured(self, topic: Topic[Any], reading: ForceReading | SkinReading, gate_middle: Instant) -> MeasuredFields:
        return {  # four hundred a second: one dictionary, not one made of another
            "seq": self._next_seq(topic),
            "daemon_boot_id": self._daemon_boot_id,
            "board_boot_id": self.board_boot_id,
            "t_ns": self._window_middle_ns(reading, gate_middle),
            "t_unc_ns": gate_middle.uncertainty_ns,
            "lost": self.lost(),
            "board_ticks": reading.board_ticks,
        }

    def _window_middle_ns(self, reading: ForceReading | SkinReading, gate_middle: Instant) -> int:
        """Return the UTC of the middle of a window from that of its last gate."""
        return gate_middle.utc_ns - round((reading.window_s - self._gate_s) * _NS / 2)

    def _site_force(self, force: MeasuredForce, gate_middle: Instant) -> SiteForce:
        return SiteForce(
            site=self._site_numbers[force.site],
            force_newton=force.force_newton,
            noise_newton=force.noise_newton,
            systematic_newton=force.systematic_newton,
            hidden_newton=force.hidden_newton,
            status=self._worth(force.status, gate_middle),
            at_least_newton=force.at_least_newton,
        )

    def _worth(self, status: str, gate_middle: Instant) -> Status:
        """Return what a force is worth: less once its calibration has expired."""
        calibration = self._plate.calibration
        if calibration.expiry is not None and calibration.expired(utc_day(gate_middle.utc_ns)):
            status = "uncalibrated" if status in ("ok", "possibly_more") else status
        return _STATUS[status]

    def _contact(self, contact: measured.Contact, reading: ForceReading, gate_middle: Instant) -> ContactFields:
        if contact.id not in self._since_utc_ns:
            # Once and for all: told anew from the board's nominal rate, it would wander by milliseconds an hour.
            age_s = (reading.board_ticks - contact.since_ticks) / self._plate.counter.reference_hz
            self._since_utc_ns[contact.id] = self._window_middle_ns(reading, gate_middle) - round(age_s * _NS)
        touch = contact.touch
        (x_variance, covariance), (_, y_variance) = touch.position_covariance_m2.tolist()
        x_std, y_std = math.sqrt(x_variance), math.sqrt(y_variance)
        correlation = covariance / (x_std * y_std) if x_std * y_std > 0 else 0.0
        return ContactFields(
            id=contact.id,
            site=self._site_numbers[touch.site],
            position_m=touch.position_m,
            position_std_m=(x_std, y_std),
            position_correlation=correlation,
            force_newton=touch.force_newton,
            noise_newton=touch.noise_newton,
            systematic_newton=touch.systematic_newton,
            hidden_newton=touch.hidden_newton,
            peak_newton=contact.peak_newton,
            since_t_ns=self._since_utc_ns[contact.id],
            duration_s=contact.duration_ticks / self._plate.counter.reference_hz,
            status=self._worth(touch.status, gate_middle),
            reason=touch.reason,
            at_least_newton=touch.at_least_newton,
        )


def _compensation(made: MeasuredCompensation) -> Compensation:
    return Compensation(
        baseline=made.baseline,
        common_mode=made.common_mode,
        common_mode_std=made.common_mode_std,
        plate_kelvin=made.plate_kelvin,
        plate_kelvin_std=made.plate_kelvin_std,
        response=made.response,
    )


def utc_day(utc_ns: int) -> date:
    """Return the day of a moment, in UTC."""
    return date.fromordinal(_EPOCH_DAY + utc_ns // _DAY_NS)


def _pairs(positions_m: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in positions_m)
