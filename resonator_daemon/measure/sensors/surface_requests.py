"""Requests to what decodes a skin, and its replies; without the decoder, which is slow to import."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate_tables import Skin as PlateSkin
from resonator_daemon.base.reasons import Reason
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.skin import DecodingOptions, Prior, Skin
from resonator_daemon.measure.sensors.surface_messages import SurfaceMessages
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.payloads import EventContact, Message, SkinInfo
from resonator_daemon.mqtt.topics import HeaderFields

Outcome = Literal["ready", "decoded", "too_old", "no_noise"]


@dataclass(frozen=True)
class SurfaceSettings:
    """Settings from which the messages about one skin follow.

    Attributes
    ----------
    skin, options
    site_ids
        Shape (n,).
    pitch_m
        Pitch of the grid that the sites form; None if they are scattered.
    decoder_id
        Key of the messages; None for a daemon.
    uncertainty
        Whether `decoded` has the traction's standard deviation.
    last_contact_id
        Number of the last contact so far; numbers go on from there.
    cold_at_rest
        Whether the decoder starts cold at each frame at rest. What follows then does not depend on what was before.
    numbered
        As of `SurfaceMessages`.
    """

    skin: Skin
    options: DecodingOptions
    site_ids: NDArray[np.integer]
    pitch_m: float | None
    decoder_id: str | None = None
    uncertainty: bool = True
    last_contact_id: int = 0
    cold_at_rest: bool = False
    numbered: bool = True

    def messages(self) -> SurfaceMessages:
        """Return the maker of this skin's messages."""
        return SurfaceMessages(
            self.site_ids,
            self.skin.site_positions_m,
            self.pitch_m,
            self.decoder_id,
            uncertainty=self.uncertainty,
            numbered=self.numbered,
        )


def stated_skin(stated: PlateSkin | SkinInfo, site_positions_m: Floats) -> Skin:
    """Return the skin that a plate file or `info` states; ValueError if it cannot be one."""
    return Skin(
        HalfSpace(stated.youngs_modulus_pascal, stated.poisson_ratio),
        site_positions_m,
        stated.depth_m,
        stated.gain_std,
        Prior(stated.correlation_length_m, stated.tangential_ratio),
        depth_std_m=stated.depth_std_m,
        modulus_std_pascal=stated.modulus_std_pascal,
        gain_std_common=stated.gain_std_common,
        position_std_m=stated.position_std_m,
    )


@dataclass(frozen=True)
class SurfaceFrame:
    """One frame to be decoded.

    Attributes
    ----------
    header
        Header of `decoded` and `decoded/summary`.
    contacts_seq
        Number `seq` of `contacts`.
    signals, noise_std
        Shape (3, n), dimensionless.
    at_rest
        Whether nothing has touched the skin for a while, as of a `SkinReading`.
    """

    header: HeaderFields
    contacts_seq: int
    signals: Floats
    noise_std: Floats
    at_rest: bool = False


@dataclass(frozen=True)
class Work:
    """Request to decode a frame, unless its time, by CLOCK_MONOTONIC, is over; `is_last`: no other frame waits."""

    frame: SurfaceFrame
    until_ns: int
    is_last: bool = True


@dataclass(frozen=True)
class EndContacts:
    """Request to release all contacts; `header` is that of the message on `contacts`, None if there are no contacts."""

    header: HeaderFields | None
    reason: Reason


@dataclass(frozen=True)
class Results:
    """Messages that follow from a request, by the path of their topic; the last reply to a request has its outcome.

    Attributes
    ----------
    messages
        The publisher numbers the events: their `seq` here is that of the frame.
    outcome
    present
        The contacts between onset and release after these messages; None if they are the same as before.
    suspects
        Identifiers of the suspect sites; None if they are the same as before.
    """

    messages: tuple[tuple[str, Message | Encoded], ...]
    outcome: Outcome | None
    present: tuple[EventContact, ...] | None = None
    suspects: tuple[int, ...] | None = None


@dataclass(frozen=True)
class SetUpStep:
    """A step of a set-up begins; "" when the set-up is done."""

    step: str


@dataclass(frozen=True)
class Undecodable:
    """The sites cannot be decoded, for the given reason; nothing more is served."""

    reason: str


Request = Work | EndContacts
Reply = Results | SetUpStep | Undecodable
