"""Readings to payloads: who measured what when, in the words and units of the MQTT contract."""

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.acquisition.clock import Instant
from resonator_daemon.acquisition.frames import BoardOnline, Outage
from resonator_daemon.config import Config
from resonator_daemon.decoding.decoded import Decoded as DecodedFrame
from resonator_daemon.decoding.skin_contacts import SkinContact, SkinEvent
from resonator_daemon.decoding.skin_decoder import SurfaceReading
from resonator_daemon.measurement import contacts as measured
from resonator_daemon.measurement.matching import SiteForce as MeasuredForce
from resonator_daemon.measurement.readings import ForceReading, SkinReading
from resonator_daemon.publishing.payloads import (
    CalibrationInfo,
    Compensation,
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
    OutageInfo,
    Patch,
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

Floats = NDArray[np.float64]

_NS = 1_000_000_000
_FRICTION_KNOWN = 0.25  # relative standard deviation


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
    position_correlation: float
    force_newton: float
    noise_newton: float
    systematic_newton: float
    hidden_newton: float
    peak_newton: float
    since_t_ns: int
    duration_s: float
    status: Status
    reason: str
    at_least_newton: float | None


class _SlipFields(TypedDict):
    stick_ratio: float
    slip_margin: float
    slip_margin_std: float
    friction_coefficient: float
    friction_coefficient_std: float


_UNKNOWN_SLIP = _SlipFields(
    stick_ratio=math.nan,
    slip_margin=math.nan,
    slip_margin_std=math.nan,
    friction_coefficient=math.nan,
    friction_coefficient_std=math.nan,
)


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

    def state(
        self,
        topic: Topic[Any],
        condition: Condition,
        reason: str,
        since_utc_ns: int,
        outage: Outage | None = None,
    ) -> State:
        told = None
        if outage is not None:
            told = OutageInfo(
                start_t_ns=outage.start_utc_ns,
                end_t_ns=outage.end_utc_ns,
                frames_lost=outage.frames_lost,
                reason=outage.reason,
            )
        return State(**self.header(topic), state=condition, reason=reason, since_t_ns=since_utc_ns, last_outage=told)

    def info(self, board: BoardOnline, link: str) -> Info:
        plate, measurement = self._plate, self._config.measurement
        gate_s = 1 / plate.counter.frame_rate_hz
        windowed = plate.skin is None
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
            calibration=self._calibration(),
        )

    def forces(self, reading: ForceReading, gate_middle: Instant) -> Forces:
        return Forces(
            **self._measured(FORCES, reading, gate_middle),
            window_s=reading.window_s,
            status=Status(reading.status),
            reason=reading.reason,
            sites=tuple(self._site_force(force) for force in reading.sites),
            beats=reading.beats,
            compensation=Compensation(**asdict(reading.compensation)),
        )

    def contacts(self, reading: ForceReading, gate_middle: Instant) -> Contacts:
        return Contacts(
            **self._measured(CONTACTS, reading, gate_middle),
            status=Status(reading.status),
            reason=reading.reason,
            contacts=tuple(Contact(**self._contact(contact, reading, gate_middle)) for contact in reading.contacts),
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
        p_n, eps_xz, eps_yz = (_median(std) for std in reading.noise_std)
        return Signals(
            **self._measured(SIGNALS, reading, gate_middle), signals=reading.signals, noise_std=(p_n, eps_xz, eps_yz)
        )

    def decoded(self, reading: SkinReading, gate_middle: Instant, frame: DecodedFrame) -> Decoded:
        grid = self._plate.grid
        x, y = self._plate.site_positions_m[0]
        return Decoded(
            **self._measured(DECODED, reading, gate_middle),
            traction_pascal=frame.traction_pascal,
            traction_std_pascal=frame.traction_std_pascal,
            displacement_m=frame.displacement_m,
            grid=Grid(origin_m=(float(x), float(y)), pitch_m=grid.pitch_m) if grid else None,
        )

    def summary(self, reading: SkinReading, gate_middle: Instant, surface: SurfaceReading) -> DecodedSummary:
        frame = surface.decoded
        return DecodedSummary(
            **self._measured(DECODED_SUMMARY, reading, gate_middle),
            decoder=surface.decoder,
            chi2=float(frame.chi2),
            border_contact=bool(frame.border_contact),
            status=Status(str(frame.status)),
            reason=str(frame.reason),
            patches=tuple(_patch(contact) for contact in surface.contacts),
        )

    def skin_contacts(self, reading: SkinReading, gate_middle: Instant, surface: SurfaceReading) -> Contacts:
        return Contacts(
            **self._measured(CONTACTS, reading, gate_middle),
            status=Status(str(surface.decoded.status)),
            contacts=tuple(
                Contact(**self._skin_contact(contact, reading, gate_middle)) for contact in surface.contacts
            ),
        )

    def skin_event(self, event: SkinEvent, reading: SkinReading, gate_middle: Instant) -> ContactEvent:
        contact, slip = self._skin_contact(event.contact, reading, gate_middle), _slip(event.contact)
        if event.event == "release":
            del self._since_utc_ns[event.contact.id]
        return ContactEvent(
            **self._measured(CONTACT_EVENT, reading, gate_middle),
            event=event.event,
            contact=EventContact(
                **contact,
                slip_margin=slip["slip_margin"],
                slip_margin_std=slip["slip_margin_std"],
                friction_coefficient=slip["friction_coefficient"],
            ),
        )

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

    def _measured(self, topic: Topic[Any], reading: ForceReading | SkinReading, gate_middle: Instant) -> _Measured:
        middle = gate_middle._replace(utc_ns=self._window_middle_ns(reading, gate_middle))
        return _Measured(**self._header(topic, middle), board_ticks=reading.board_ticks)

    def _window_middle_ns(self, reading: ForceReading | SkinReading, gate_middle: Instant) -> int:
        """Return the UTC of the middle of a window from that of its last gate."""
        gate_s = 1 / self._plate.counter.frame_rate_hz
        return gate_middle.utc_ns - round((reading.window_s - gate_s) * _NS / 2)

    def _site_force(self, force: MeasuredForce) -> SiteForce:
        return SiteForce(
            site=int(self._plate.site_ids[force.site]),
            force_newton=force.force_newton,
            noise_newton=force.noise_newton,
            systematic_newton=force.systematic_newton,
            hidden_newton=force.hidden_newton,
            status=self._worth(force.status),
            at_least_newton=force.at_least_newton,
        )

    def _worth(self, status: str) -> Status:
        """Return what a force is worth: less once its calibration has expired."""
        expired = self._plate.calibration.expired(datetime.now(UTC).date())
        return Status.UNCALIBRATED if expired and status in ("ok", "possibly_more") else Status(status)

    def _contact(self, contact: measured.Contact, reading: ForceReading, gate_middle: Instant) -> _ContactFields:
        if contact.id not in self._since_utc_ns:
            # Once and for all: told anew from the board's nominal rate, it would wander by milliseconds an hour.
            age_s = (reading.board_ticks - contact.since_ticks) / self._plate.counter.reference_hz
            self._since_utc_ns[contact.id] = self._window_middle_ns(reading, gate_middle) - round(age_s * _NS)
        touch = contact.touch
        x_std, y_std = np.sqrt(np.diag(touch.position_covariance_m2)).tolist()
        correlation = float(touch.position_covariance_m2[0, 1]) / (x_std * y_std) if x_std * y_std > 0 else 0.0
        return _ContactFields(
            id=contact.id,
            site=int(self._plate.site_ids[touch.site]),
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
            status=self._worth(touch.status),
            reason=touch.reason,
            at_least_newton=touch.at_least_newton,
        )

    def _skin_contact(self, contact: SkinContact, reading: SkinReading, gate_middle: Instant) -> _ContactFields:
        patch, middle_ns = contact.patch, self._window_middle_ns(reading, gate_middle)
        nearest = int(np.hypot(*(self._plate.site_positions_m - patch.centroid_m).T).argmin())
        since_ns = self._since_utc_ns.setdefault(contact.id, middle_ns)
        return _ContactFields(
            id=contact.id,
            site=int(self._plate.site_ids[nearest]),
            position_m=_pair(patch.centroid_m),
            position_std_m=_pair(patch.centroid_std_m),
            position_correlation=math.nan,
            force_newton=float(patch.force_newton[2]),
            noise_newton=float(patch.force_std_newton[2]),
            systematic_newton=math.nan,  # the plate file does not say how well its elastic constants are known
            hidden_newton=0.0,
            peak_newton=contact.peak_newton,
            since_t_ns=since_ns,
            duration_s=(middle_ns - since_ns) / _NS,
            status=Status.OK,
            reason="",
            at_least_newton=None,
        )


def _patch(contact: SkinContact) -> Patch:
    patch = contact.patch
    return Patch(
        id=contact.id,
        centroid_m=_pair(patch.centroid_m),
        centroid_std_m=_pair(patch.centroid_std_m),
        area_m2=patch.area_m2,
        force_newton=_triple(patch.force_newton),
        force_std_newton=_triple(patch.force_std_newton),
        moment_newton_m=_triple(patch.moment_newton_m),
        moment_std_newton_m=_triple(patch.moment_std_newton_m),
        at_border=patch.at_border,
        radius_of_curvature_m=contact.radius_of_curvature_m,
        slip_reason=contact.slip.reason if contact.slip else "nothing was fitted",
        **_slip(contact),
    )


def _slip(contact: SkinContact) -> _SlipFields:
    """Say what the fit tells of slip; a friction coefficient only where that is known to a quarter."""
    slip = contact.slip
    if slip is None:
        return _UNKNOWN_SLIP
    known = slip.friction_coefficient_std < _FRICTION_KNOWN * slip.friction_coefficient
    return _SlipFields(
        stick_ratio=slip.stick_ratio,
        slip_margin=slip.slip_margin,
        slip_margin_std=slip.slip_margin_std,
        friction_coefficient=slip.friction_coefficient if known else math.nan,
        friction_coefficient_std=slip.friction_coefficient_std if known else math.nan,
    )


def _pair(values: Floats) -> tuple[float, float]:
    x, y = values.tolist()
    return x, y


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else math.nan
