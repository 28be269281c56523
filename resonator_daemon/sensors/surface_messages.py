"""What was decoded of a skin to payloads: the same words wherever it is decoded."""

import math
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.arrays import Floats
from resonator_daemon.publishing.headers import MeasuredFields
from resonator_daemon.publishing.payloads import (
    Contact,
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    EventContact,
    Grid,
    Patch,
    Status,
)

if TYPE_CHECKING:
    from resonator_daemon.decoding.decoded import Decoded as DecodedFrame
    from resonator_daemon.decoding.skin_contacts import SkinContact, SkinEvent
    from resonator_daemon.decoding.skin_decoder import SurfaceReading

_NS = 1_000_000_000
_ON_GRID = 3  # dimensions of a map: component, y, x
_FRICTION_KNOWN = 0.25  # relative standard deviation


class ContactFields(TypedDict):
    """A contact, of a skin or of force sites."""

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
    """

    def __init__(
        self,
        site_ids: NDArray[np.integer],
        site_positions_m: Floats,
        pitch_m: float | None,
        decoder_id: str | None = None,
        *,
        uncertainty: bool = True,
    ) -> None:
        self._site_ids = site_ids
        self._site_positions_m = site_positions_m
        x, y = site_positions_m[0]
        self._grid = Grid(origin_m=(float(x), float(y)), pitch_m=pitch_m) if pitch_m is not None else None
        self._decoder_id = decoder_id
        self._uncertainty = uncertainty
        self._since_utc_ns: dict[int, int] = {}  # onsets of the present contacts, by id

    def decoded(self, header: MeasuredFields, frame: "DecodedFrame") -> Decoded:
        return Decoded(
            **header,
            traction_pascal=frame.traction_pascal,
            traction_std_pascal=frame.traction_std_pascal if self._uncertainty else None,
            displacement_m=frame.displacement_m,
            grid=self._grid if frame.traction_pascal.ndim == _ON_GRID else None,
            decoder_id=self._decoder_id,
        )

    def summary(self, header: MeasuredFields, surface: "SurfaceReading", *, numbered: bool = True) -> DecodedSummary:
        """Return the summary; `numbered`: contacts are followed, and have ids."""
        frame = surface.decoded
        return DecodedSummary(
            **header,
            decoder=surface.decoder,
            chi2=float(frame.chi2),
            border_contact=bool(frame.border_contact),
            status=Status(str(frame.status)),
            reason=str(frame.reason),
            patches=tuple(_patch(contact, contact.id if numbered else None) for contact in surface.contacts),
            decoder_id=self._decoder_id,
        )

    def contacts(self, header: MeasuredFields, surface: "SurfaceReading") -> Contacts:
        return Contacts(
            **header,
            status=Status(str(surface.decoded.status)),
            contacts=tuple(Contact(**self._contact(contact, header["t_ns"])) for contact in surface.contacts),
            decoder_id=self._decoder_id,
        )

    def event(self, header: MeasuredFields, event: "SkinEvent") -> ContactEvent:
        contact, slip = self._contact(event.contact, header["t_ns"]), _slip(event.contact)
        if event.event == "release":
            del self._since_utc_ns[event.contact.id]
        return ContactEvent(
            **header,
            event=event.event,
            reason=event.reason,
            contact=EventContact(
                **contact,
                slip_margin=slip["slip_margin"],
                slip_margin_std=slip["slip_margin_std"],
                friction_coefficient=slip["friction_coefficient"],
            ),
            decoder_id=self._decoder_id,
        )

    def _contact(self, contact: "SkinContact", middle_ns: int) -> ContactFields:
        patch = contact.patch
        nearest = int(np.hypot(*(self._site_positions_m - patch.centroid_m).T).argmin())
        since_ns = self._since_utc_ns.setdefault(contact.id, middle_ns)
        return ContactFields(
            id=contact.id,
            site=int(self._site_ids[nearest]),
            position_m=_pair(patch.centroid_m),
            position_std_m=_pair(patch.centroid_std_m),
            position_correlation=math.nan,
            force_newton=float(patch.force_newton[2]),
            noise_newton=float(patch.force_std_newton[2]),
            systematic_newton=math.nan,  # the uncertainty of the skin's elastic constants is not known
            hidden_newton=0.0,
            peak_newton=contact.peak_newton,
            since_t_ns=since_ns,
            duration_s=(middle_ns - since_ns) / _NS,
            status=Status.OK,
            reason="",
            at_least_newton=None,
        )


def _patch(contact: "SkinContact", number: int | None) -> Patch:
    patch = contact.patch
    return Patch(
        id=number,
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


def _slip(contact: "SkinContact") -> _SlipFields:
    """Return the fields about slip; a friction coefficient only where it is known to a quarter."""
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
