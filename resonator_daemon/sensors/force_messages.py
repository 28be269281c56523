"""Readings of force sites to payloads: forces, contacts and their events."""

import math
from collections.abc import Callable
from dataclasses import fields
from operator import attrgetter
from typing import Any, Final

from resonator_daemon.forces import contacts as measured
from resonator_daemon.forces.readings import Compensation as MeasuredCompensation
from resonator_daemon.forces.readings import ForceReading
from resonator_daemon.forces.site_identification import SiteForce as MeasuredForce
from resonator_daemon.plate import Plate
from resonator_daemon.publishing.codec import Encoded, encode_fields
from resonator_daemon.publishing.payloads import (
    Baseline,
    Compensation,
    ContactEvent,
    Contacts,
    EventContact,
    Forces,
    Message,
    ResponseCompensation,
    SiteForce,
    Status,
)
from resonator_daemon.publishing.topics import CONTACT_EVENT, CONTACTS, FORCES
from resonator_daemon.sensors.calendar import utc_day
from resonator_daemon.sensors.output import MessageOutput
from resonator_daemon.sensors.surface_messages import ContactFields
from resonator_daemon.session.clock import Instant

_NS: Final = 1_000_000_000
_STATUS = {str(word): word for word in Status}
_BASELINE = {str(word): word for word in Baseline}
_RESPONSE = {str(word): word for word in ResponseCompensation}


def _common_fields(reading: type[Any], payload: type[Message]) -> Callable[[Any], dict[str, Any]]:
    """Return a function from a reading to those of its fields that the payload has under the same name."""
    names = [field.name for field in fields(reading) if field.name in payload.model_fields]
    values = attrgetter(*names)
    return lambda measured: dict(zip(names, values(measured), strict=True))


_forces_of = _common_fields(ForceReading, Forces)
_compensation_of = _common_fields(MeasuredCompensation, Compensation)
_site_force_of = _common_fields(MeasuredForce, SiteForce)


class ForceMessages:
    """Makes the messages about readings of one plate.

    Parameters
    ----------
    plate
    output
        Makes the headers.
    """

    def __init__(self, plate: Plate, output: MessageOutput) -> None:
        self._plate = plate
        self._output = output
        self._headers = output.headers
        self._site_ids: list[int] = plate.site_ids.tolist()
        self._since_utc_ns: dict[int, int] = {}  # of the present contacts, by id

    def header(self, reading: ForceReading, gate_middle: Instant) -> dict[str, Any]:
        """Return what both messages about a reading share; `gate_middle` is that of the last gate in the window."""
        middle_ns = self._output.window_middle_ns(reading, gate_middle)
        header = self._headers.of_window(middle_ns, gate_middle.uncertainty_ns, reading.board_ticks)
        return {**header, "lost": vars(header["lost"])}

    def forces(self, header: dict[str, Any], reading: ForceReading, gate_middle: Instant) -> Encoded:
        return encode_fields(
            Forces,
            {
                "seq": self._headers.next_seq(FORCES),
                **header,
                **_forces_of(reading),
                "status": _STATUS[reading.status],
                "sites": tuple([self._site_force(force, gate_middle) for force in reading.sites]),
                "compensation": {
                    **_compensation_of(reading.compensation),
                    "baseline": _BASELINE[reading.compensation.baseline],
                    "response": _RESPONSE[reading.compensation.response],
                },
            },
        )

    def contacts(self, header: dict[str, Any], reading: ForceReading, gate_middle: Instant) -> Encoded:
        return encode_fields(
            Contacts,
            {
                "seq": self._headers.next_seq(CONTACTS),
                **header,
                "status": _STATUS[reading.status],
                "reason": reading.reason,
                "contacts": tuple([self._contact(contact, reading, gate_middle) for contact in reading.contacts]),
                "decoder_id": None,
            },
        )

    def event(self, event: measured.ContactEvent, reading: ForceReading, gate_middle: Instant) -> ContactEvent:
        contact = self._contact(event.contact, reading, gate_middle)
        if event.event == "release":
            del self._since_utc_ns[event.contact.id]
        return ContactEvent(
            **self._output.header(CONTACT_EVENT, reading, gate_middle),
            event=event.event,
            reason=event.reason,
            contact=EventContact(**contact),
        )

    def _site_force(self, force: MeasuredForce, gate_middle: Instant) -> dict[str, Any]:
        common = _site_force_of(force)
        return {**common, "site": self._site_ids[force.site], "status": self._worth(force.status, gate_middle)}

    def _worth(self, status: str, gate_middle: Instant) -> Status:
        """Return what a force is worth: less once its calibration has expired."""
        calibration = self._plate.calibration
        if calibration.expiry is not None and calibration.expired(utc_day(gate_middle.utc_ns)):
            status = "uncalibrated" if status in ("ok", "possibly_more") else status
        return _STATUS[status]

    def _contact(self, contact: measured.Contact, reading: ForceReading, gate_middle: Instant) -> ContactFields:
        if contact.id not in self._since_utc_ns:
            # Fixed once: computed again from the board's nominal rate, it would wander by milliseconds an hour.
            age_s = (reading.board_ticks - contact.since_ticks) / self._plate.counter.reference_hz
            self._since_utc_ns[contact.id] = self._output.window_middle_ns(reading, gate_middle) - round(age_s * _NS)
        touch = contact.touch
        (x_variance, covariance), (_, y_variance) = touch.position_covariance_m2.tolist()
        x_std, y_std = math.sqrt(x_variance), math.sqrt(y_variance)
        correlation = covariance / (x_std * y_std) if x_std * y_std > 0 else 0.0
        return ContactFields(
            id=contact.id,
            site=self._site_ids[touch.site],
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
