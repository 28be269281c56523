"""What was decoded of a skin to payloads: the same words wherever it is decoded."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.measure.sensors.output import reason_fields
from resonator_daemon.mqtt.payload_types import rounded, rounded_std
from resonator_daemon.mqtt.payloads import (
    Contact,
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    EventContact,
    FitQuality,
    Grid,
    Patch,
    Status,
)
from resonator_daemon.mqtt.topics import HeaderFields

if TYPE_CHECKING:
    from resonator_daemon.estimate.surface.decoded import Decoded as DecodedFrame
    from resonator_daemon.estimate.surface.fitting.shape_fit import ShapeFit
    from resonator_daemon.estimate.surface.skin_contacts import SkinContact, SkinEvent
    from resonator_daemon.estimate.surface.skin_decoder import SurfaceReading

_NS = 1_000_000_000
_ON_GRID = 3  # dimensions of a map: component, y, x
_FRICTION_KNOWN = 0.25  # relative standard deviation
_SLIP = (
    *("slip_margin", "slip_margin_std", "slip_margin_systematic"),
    *("friction_coefficient", "friction_coefficient_std", "friction_coefficient_systematic"),
)


class SurfaceMessages:
    """Makes the messages of one skin's surface, each under a header that belongs to its frame.

    Parameters
    ----------
    site_ids
        (n,).
    site_positions_m
        In the same order, (n, 2).
    pitch_m
        Of the grid that the sites form; None where they are scattered.
    decoder_id
        Of the process that decodes; None for the daemon itself.
    uncertainty
        Whether `decoded` has the traction's standard deviation.
    numbered
        Whether patches have the ids of `contacts`.

    Attributes
    ----------
    present
        Each contact between its onset and its release as it was published last, by id.
    """

    def __init__(
        self,
        site_ids: NDArray[np.integer],
        site_positions_m: Floats,
        pitch_m: float | None,
        decoder_id: str | None = None,
        *,
        uncertainty: bool = True,
        numbered: bool = True,
    ) -> None:
        self._site_ids = site_ids
        self._site_positions_m = site_positions_m
        x, y = site_positions_m[0]
        self._grid = Grid(origin_m=(float(x), float(y)), pitch_m=pitch_m) if pitch_m is not None else None
        self._decoder_id = decoder_id
        self._uncertainty = uncertainty
        self._numbered = numbered
        self.present: dict[int, EventContact] = {}

    def decoded(self, header: HeaderFields, frame: "DecodedFrame") -> Decoded:
        return Decoded(
            **header,
            traction_pascal=frame.traction_pascal,
            traction_std_pascal=frame.traction_std_pascal if self._uncertainty else None,
            displacement_m=frame.displacement_m,
            grid=self._grid if frame.traction_pascal.ndim == _ON_GRID else None,
            decoder_id=self._decoder_id,
        )

    def summary(self, header: HeaderFields, surface: "SurfaceReading") -> DecodedSummary:
        frame = surface.decoded
        return DecodedSummary(
            **header,
            decoder=surface.decoder,
            border_contact=bool(frame.border_contact),
            status=Status(str(frame.status)),
            reason_code=_code(frame),
            reason=str(frame.reason) or None,
            patches=tuple(self._patch(contact) for contact in surface.contacts),
            decoder_id=self._decoder_id,
        )

    def contacts(self, header: HeaderFields, surface: "SurfaceReading") -> Contacts:
        frame, present = surface.decoded, self.present
        contacts = tuple(Contact(**self._contact(contact)) for contact in surface.contacts)
        for contact, message in zip(surface.contacts, contacts, strict=True):
            if (before := present.get(contact.id)) is not None:
                present[contact.id] = EventContact.model_construct(
                    **dict(message),
                    peak_newton=max(before.peak_newton, message.force_newton[2]),
                    since_t_ns=before.since_t_ns,
                    duration_s=(header["t_ns"] - before.since_t_ns) / _NS,
                )
        return Contacts(
            **header,
            status=Status(str(frame.status)),
            reason_code=_code(frame),
            contacts=contacts,
            decoder_id=self._decoder_id,
        )

    def event(self, header: HeaderFields, event: "SkinEvent") -> ContactEvent:
        contact, middle_ns = event.contact, header["t_ns"]
        before = self.present.pop(contact.id, None)
        since_ns = before.since_t_ns if before is not None else middle_ns
        duration_s = (middle_ns - since_ns) / _NS
        if event.event == "release":
            duration_s = before.duration_s if before is not None else 0.0
        described = EventContact(
            **self._contact(contact),
            peak_newton=rounded(contact.peak_newton, float(contact.patch.force_std_newton[2])),
            since_t_ns=since_ns,
            duration_s=duration_s,
        )
        if event.event != "release":
            self.present[contact.id] = described
        return ContactEvent(
            **header, event=event.event, **reason_fields(event.reason), contact=described, decoder_id=self._decoder_id
        )

    def _contact(self, contact: "SkinContact") -> dict[str, Any]:
        patch = contact.patch
        nearest = int(np.hypot(*(self._site_positions_m - patch.centroid_m).T).argmin())
        x_std, y_std = patch.centroid_std_m.tolist()
        return {
            "id": contact.id,
            "site": int(self._site_ids[nearest]),
            "position_m": _rounded(patch.centroid_m, patch.centroid_std_m),
            "position_covariance_m2": (rounded_std(x_std**2), math.nan, rounded_std(y_std**2)),
            "force_newton": _rounded(patch.force_newton, patch.force_std_newton),
            "noise_newton": _rounded_std(patch.force_std_newton),
            "systematic_newton": _rounded_std(contact.systematic.force_newton),
            "position_systematic_m": _rounded_std(contact.systematic.position_m),
            "moment_newton_m": _rounded(patch.moment_newton_m, patch.moment_std_newton_m),
            "moment_std_newton_m": _rounded_std(patch.moment_std_newton_m),
            **_slip(contact),
            "fit": _fit(contact),
            "shape": contact.shape,
            "status": Status(contact.status),
            "reason_code": contact.reason,
        }

    def _patch(self, contact: "SkinContact") -> Patch:
        patch, slip = contact.patch, contact.slip
        stick = (slip.stick_ratio, slip.stick_ratio_std) if slip is not None else (math.nan, math.nan)
        return Patch(
            id=contact.id if self._numbered else None,
            area_m2=rounded(contact.area_m2, contact.area_std_m2),
            area_std_m2=rounded_std(contact.area_std_m2),
            at_border=patch.at_border,
            **_half_axes(contact.shape_fit),
            radius_of_curvature_m=rounded(contact.radius_of_curvature_m, contact.radius_of_curvature_std_m),
            radius_of_curvature_std_m=rounded_std(contact.radius_of_curvature_std_m),
            stick_ratio=rounded(*stick),
            stick_ratio_std=rounded_std(stick[1]),
        )


def _code(frame: "DecodedFrame") -> ReasonCode | None:
    return ReasonCode(str(frame.reason_code)) if frame.reason_code else None


def _fit(contact: "SkinContact") -> FitQuality | None:
    if (fit := contact.fit) is None:
        return None
    return FitQuality(chi2=round(fit.chi2, 4), degrees_of_freedom=fit.degrees_of_freedom, p=rounded_std(fit.p))


def _half_axes(shape: "ShapeFit | None") -> dict[str, Any]:
    if shape is None:
        return {}
    fields: dict[str, Any] = {
        "short_half_axis_m": rounded(shape.short_half_axis_m, shape.short_half_axis_std_m),
        "short_half_axis_std_m": rounded_std(shape.short_half_axis_std_m),
    }
    if shape.shape == "ellipse":
        fields["long_half_axis_m"] = _rounded(shape.long_half_axis_m, shape.long_half_axis_std_m)
        fields["long_half_axis_std_m"] = _rounded_std(shape.long_half_axis_std_m)
    return fields


def _slip(contact: "SkinContact") -> dict[str, Any]:
    """Return the fields about slip; a friction coefficient only where it is known to a quarter."""
    slip = contact.slip
    if slip is None:
        return {**dict.fromkeys(_SLIP, math.nan), "slip_reason_code": ReasonCode.NOT_FITTED}
    reason_code = slip.reason.code if slip.reason is not None else None
    friction, friction_std = slip.friction_coefficient, slip.friction_coefficient_std
    friction_systematic = slip.friction_coefficient_systematic
    if not friction_std < _FRICTION_KNOWN * friction:
        friction = friction_std = friction_systematic = math.nan
        reason_code = reason_code or ReasonCode.FRICTION_UNKNOWN
    margin_std = slip.slip_margin_std
    numbers = (
        rounded(slip.slip_margin, margin_std),
        rounded_std(margin_std),
        rounded_std(contact.systematic.slip_margin),
        rounded(friction, friction_std),
        rounded_std(friction_std),
        rounded_std(friction_systematic),
    )
    return {**dict(zip(_SLIP, numbers, strict=True)), "slip_reason_code": reason_code}


def _rounded(values: Floats, std: Floats) -> tuple[float, ...]:
    return tuple(map(rounded, values.tolist(), std.tolist()))


def _rounded_std(std: Floats) -> tuple[float, ...]:
    return tuple(map(rounded_std, std.tolist()))
