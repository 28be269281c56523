"""Readings of force sites to payloads: forces, contacts and their events."""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.plate import Plate
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.estimate.forces import readings as measured
from resonator_daemon.estimate.forces.readings import ForceReading
from resonator_daemon.estimate.forces.site_identification import SiteForce as MeasuredForce
from resonator_daemon.measure.sensors.output import MessageOutput, reason_fields, utc_day
from resonator_daemon.measure.sensors.plate_sites import force_sites
from resonator_daemon.mqtt.codec import Encoded, encode_fields
from resonator_daemon.mqtt.payload_types import rounded, rounded_std
from resonator_daemon.mqtt.payloads import (
    CapturedTone,
    ContactEvent,
    Contacts,
    EventContact,
    Forces,
    Lost,
    SiteCode,
    Status,
    Tones,
)
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS, FORCES

_NS: Final = 1_000_000_000
_STATUS = {str(word): word for word in Status}


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
        self._lost: Lost | None = None  # of the last message
        self._lost_fields: dict[str, int] = {}

    def header(self, reading: ForceReading, gate_middle: Instant) -> dict[str, Any]:
        """Return what all messages about a reading share; `gate_middle` is that of the last gate in the window."""
        window = self._output.window(reading, gate_middle)
        lost = window["lost"]
        if lost is not self._lost:  # hundreds of messages repeat the last one
            self._lost, self._lost_fields = lost, {cause: count for cause, count in vars(lost).items() if count}
        fields = {**window, "lost": self._lost_fields, "status": _STATUS[reading.status]}
        if reading.reason is not None:
            fields["reason_code"] = reading.reason.code
        return fields

    def forces(self, header: dict[str, Any], reading: ForceReading, gate_middle: Instant) -> Encoded:
        fields = {
            "name": header["name"],
            "seq": self._headers.next_seq(FORCES),
            **header,
            "window_s": reading.window_s,
            "sites": tuple([self._site_force(force, gate_middle) for force in reading.sites]) if reading.sites else (),
        }
        if reading.reason is not None:
            fields["reason"] = reading.reason.text
        if reading.beats:
            fields["beats"] = reading.beats
        return encode_fields(Forces, fields)

    def contacts(self, header: dict[str, Any], reading: ForceReading, gate_middle: Instant) -> Encoded:
        fields = {"name": header["name"], "seq": self._headers.next_seq(CONTACTS), **header, "contacts": ()}
        if reading.contacts:
            fields["contacts"] = tuple([self._contact(contact, gate_middle) for contact in reading.contacts])
        return encode_fields(Contacts, fields)

    def event(self, event: measured.ContactEvent, reading: ForceReading, gate_middle: Instant) -> ContactEvent:
        contact, window = event.contact, self._output.window(reading, gate_middle)
        since_utc_ns = self._since_utc_ns.get(contact.id)
        if since_utc_ns is None:
            # Fixed once: computed again from the board's nominal rate, it would wander by milliseconds an hour.
            age_s = (reading.board_ticks - contact.since_ticks) / self._plate.counter.reference_hz
            since_utc_ns = window["t_ns"] - round(age_s * _NS)
            self._since_utc_ns[contact.id] = since_utc_ns
        if event.event == "release":
            del self._since_utc_ns[contact.id]
        peak_newton = rounded(contact.peak_newton, contact.peak_noise_newton)
        return ContactEvent(
            seq=self._headers.next_seq(CONTACT_EVENT),
            **window,
            event=event.event,
            **reason_fields(event.reason),
            contact=EventContact(
                **self._contact(contact, gate_middle),
                peak_newton=peak_newton,
                peak_at_least_newton=peak_newton if contact.peak_is_bound else None,
                since_t_ns=since_utc_ns,
                duration_s=contact.duration_ticks / self._plate.counter.reference_hz,
            ),
        )

    def _site_force(self, force: MeasuredForce, gate_middle: Instant) -> dict[str, Any]:
        noise_newton = force.noise_newton
        fields = {
            "site": self._site_ids[force.site],
            "force_newton": rounded(force.force_newton, noise_newton),
            "noise_newton": rounded_std(noise_newton),
            "systematic_newton": rounded_std(force.systematic_newton),
            "status": self._published_status(force.status, gate_middle),
        }
        if force.unobserved_bound_newton:
            fields["unobserved_bound_newton"] = rounded_std(force.unobserved_bound_newton)
        if force.at_least_newton is not None:
            fields["at_least_newton"] = rounded(force.at_least_newton, noise_newton)
        return fields

    def _contact(self, contact: measured.Contact, gate_middle: Instant) -> dict[str, Any]:
        touch = contact.touch
        (xx, xy), (_, yy) = touch.position_covariance_m2.tolist()
        (x, y), noise_newton = touch.position_m, touch.noise_newton
        fields = {
            "id": contact.id,
            "site": self._site_ids[touch.site],
            "position_m": (rounded(x, math.sqrt(xx)), rounded(y, math.sqrt(yy))),
            "position_covariance_m2": tuple(rounded_std(covariance, _DIGITS) for covariance in (xx, xy, yy)),
            "force_newton": (math.nan, math.nan, rounded(touch.force_newton, noise_newton)),
            "noise_newton": (math.nan, math.nan, rounded_std(noise_newton, _DIGITS)),
            "systematic_newton": (math.nan, math.nan, rounded_std(touch.systematic_newton, _DIGITS)),
            "status": self._published_status(touch.status, gate_middle),
        }
        if touch.reason is not None:
            fields["reason_code"] = touch.reason.code
        if touch.at_least_newton is not None:
            fields["at_least_newton"] = rounded(touch.at_least_newton, noise_newton)
        return fields

    def _published_status(self, status: str, gate_middle: Instant) -> Status:
        """Return the status of a force as it is published: uncalibrated once the calibration has expired."""
        calibration = self._plate.calibration
        if calibration.expiry is not None and calibration.expired(utc_day(gate_middle.utc_ns)):
            status = "uncalibrated" if status in ("ok", "possibly_more") else status
        return _STATUS[status]


_DIGITS: Final = 2  # of the errors of a contact, whose message has at most some 400 bytes
_CODE_PLACES: Final = 3
_RESIDUAL_PLACES: Final = 2


def site_codes(plate: Plate) -> tuple[SiteCode, ...]:
    """Return the codes of a plate's force sites in the order of the sites."""
    sites = force_sites(plate)
    loaded_hz = np.round(sites.f0_hz / (1.0 - sites.sensitivity * plate.force_max_newton), _CODE_PLACES)
    return tuple(
        SiteCode(site=site, f0_hz=tuple(f0_hz), full_load_hz=tuple(full_load_hz))
        for site, f0_hz, full_load_hz in zip(
            plate.site_ids.tolist(), sites.f0_hz.tolist(), loaded_hz.tolist(), strict=True
        )
    )


def tones_message(plate: Plate, seq: int, header: dict[str, Any], reading: ForceReading) -> Encoded:
    """Return the message about a reading that has tones; `header` is that of its other messages."""
    site_ids = plate.site_ids
    fields = {
        "name": header["name"],
        "seq": seq,
        **header,
        "window_s": reading.window_s,
        "corners": tuple([_corner(tone, site_ids) for tone in reading.tones or ()]),
    }
    return encode_fields(Tones, fields)


def _corner(tone: measured.CornerTone, site_ids: NDArray[np.int64]) -> dict[str, Any]:
    fields = {
        "captured": CapturedTone(tone.captured),
        "site": None if tone.site is None else int(site_ids[tone.site]),
        "frequency_hz": rounded(tone.frequency_hz, tone.noise_hz),
        "noise_hz": rounded_std(tone.noise_hz),
        "residual": round(tone.residual, _RESIDUAL_PLACES),
    }
    return fields if tone.reason_code is None else {**fields, "reason_code": tone.reason_code}
