"""Messages of a plate as those of ROS 2, in CDR; no ROS is needed."""

import re
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from resonator_daemon.errors import UserError
from resonator_daemon.exporting.clouds import Clouds, Points
from resonator_daemon.exporting.severity import severity
from resonator_daemon.plate import Plate
from resonator_daemon.publishing.payloads import (
    Contact,
    ContactEvent,
    Contacts,
    DecodedSummary,
    EventContact,
    Header,
    State,
)
from resonator_daemon.publishing.topics import Topic

try:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
except ImportError as error:
    raise UserError("messages of ROS 2 need rosbags: pip install rosbags") from error

CONTACT, CONTACTS, EVENT = (f"resonator_msgs/msg/{name}" for name in ("Contact", "Contacts", "ContactEvent"))

# Keys of a contact that are numbers, in the order of the message, and their description there.
_NUMBERS: Final = ("force_newton", "noise_newton", "systematic_newton", "hidden_newton", "peak_newton", "duration_s")
_OF_CONTACT: Final = "\n".join(
    (
        "uint64 id",
        "uint32 site",
        "float64[2] position_m",
        "float64[2] position_std_m",
        *(f"float64 {key}" for key in _NUMBERS),
        "float64 at_least_newton",
        "builtin_interfaces/Time since",
        "string status",
        "string reason",
    )
)
_OF_CONTACTS: Final = "\n".join(("std_msgs/Header header", "string status", "string reason", f"{CONTACT}[] contacts"))
_OF_EVENT: Final = "\n".join(
    (
        "std_msgs/Header header",
        "string event",
        "string reason",
        "float64 slip_margin",
        "float64 slip_margin_std",
        "float64 friction_coefficient",
        f"{CONTACT} contact",
    )
)
_FIELD: Final = "sensor_msgs/msg/PointField"
_WRENCH, _CLOUD, _DIAGNOSTICS = (
    "geometry_msgs/msg/WrenchStamped",
    "sensor_msgs/msg/PointCloud2",
    "diagnostic_msgs/msg/DiagnosticArray",
)
_DATATYPES: Final = {"<u2": 4, "<f4": 7, "<f8": 8}  # UINT16, FLOAT32, FLOAT64 of sensor_msgs/PointField


class RosMessage(NamedTuple):
    """A message and its topic, without the plate's name."""

    path: str
    kind: str
    t_ns: int
    message: Any


class RosMessages:
    """Makes messages of ROS 2 of those of one plate.

    Parameters
    ----------
    plate
        Of the recording.
    frame_id
        Names the plate's coordinates: x to the right, z into the plate; metres.
    """

    def __init__(self, plate: Plate, frame_id: str) -> None:
        self._clouds = Clouds(plate)
        self._with_map = plate.decodable
        self._frame_id = frame_id
        self._store = get_typestore(Stores.ROS2_JAZZY)
        for kind, text in ((CONTACT, _OF_CONTACT), (CONTACTS, _OF_CONTACTS), (EVENT, _OF_EVENT)):
            self._store.register(get_types_from_msg(text, kind))

    def definition(self, kind: str) -> str:
        """Return the text of a kind of message, and of all that it is made of."""
        return self._store.generate_msgdef(kind, ros_version=2)[0]

    def encode(self, message: RosMessage) -> bytes:
        """Return the message in CDR."""
        return bytes(self._store.serialize_cdr(message.message, message.kind))

    def of(self, topic: Topic[Any], message: Any) -> Iterator[RosMessage]:
        """Give what a message of the plate becomes; nothing of kinds that ROS has no use for."""
        match message:
            case Contacts():
                contacts = [self._contact(contact) for contact in message.contacts]
                yield self._own(topic, CONTACTS, message, status=message.status, contacts=contacts)
                if not self._with_map:
                    forces = [(0.0, 0.0, contact.force_newton) for contact in message.contacts]
                    moments = [_moment(contact) for contact in message.contacts]
                    yield self._wrench(message, forces, moments)
            case DecodedSummary():
                patches = message.patches
                yield self._wrench(message, [p.force_newton for p in patches], [p.moment_newton_m for p in patches])
            case ContactEvent():
                yield self._event(topic, message)
            case State():
                yield self._diagnostics(topic, message)
            case _:
                points = self._clouds.points(message)
                if points is not None:
                    yield RosMessage(f"{topic.path}/cloud", _CLOUD, message.t_ns, self._cloud(message, points))

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _time(self, t_ns: int) -> Any:
        sec, nanosec = divmod(t_ns, 10**9)
        return self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def _header(self, message: Header) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(message.t_ns), frame_id=self._frame_id)

    def _own(self, topic: Topic[Any], kind: str, message: Any, **fields: Any) -> RosMessage:
        made = self._make(
            kind, header=self._header(message), reason=message.reason, **{key: _plain(v) for key, v in fields.items()}
        )
        return RosMessage(topic.path, kind, message.t_ns, made)

    def _event(self, topic: Topic[Any], message: ContactEvent) -> RosMessage:
        contact: EventContact = message.contact
        return self._own(
            topic,
            EVENT,
            message,
            event=message.event,
            slip_margin=contact.slip_margin,
            slip_margin_std=contact.slip_margin_std,
            friction_coefficient=contact.friction_coefficient,
            contact=self._contact(contact),
        )

    def _contact(self, contact: Contact) -> Any:
        at_least = contact.at_least_newton
        return self._make(
            CONTACT,
            id=contact.id,
            site=contact.site,
            position_m=np.array(contact.position_m),
            position_std_m=np.array(contact.position_std_m),
            **{key: getattr(contact, key) for key in _NUMBERS},
            at_least_newton=np.nan if at_least is None else at_least,
            since=self._time(contact.since_t_ns),
            status=str(contact.status),
            reason=contact.reason,
        )

    def _wrench(self, message: Header, forces: list[Any], moments: list[Any]) -> RosMessage:
        """Return the sum of all contacts about the origin; NaN where that of one is not known."""
        force, torque = (
            self._make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, np.sum(parts, axis=0)), strict=True)))
            for parts in ([(0.0, 0.0, 0.0), *forces], [(0.0, 0.0, 0.0), *moments])
        )
        wrench = self._make("geometry_msgs/msg/Wrench", force=force, torque=torque)
        return RosMessage(
            "wrench", _WRENCH, message.t_ns, self._make(_WRENCH, header=self._header(message), wrench=wrench)
        )

    def _cloud(self, message: Header, points: Points) -> Any:
        fields = [
            self._make(_FIELD, name=name, offset=field[1], datatype=_DATATYPES[field[0].str], count=1)
            for name, field in (points.dtype.fields or {}).items()
        ]
        return self._make(
            _CLOUD,
            header=self._header(message),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=points.dtype.itemsize,
            row_step=points.nbytes,
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=not any(np.isnan(points[name]).any() for name in points.dtype.names or ()),
        )

    def _diagnostics(self, topic: Topic[Any], message: State) -> RosMessage:
        status = self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=severity(message.state),
            name=f"{self._frame_id}: {topic.path}",
            message=f"{message.state}: {message.reason}" if message.reason else str(message.state),
            hardware_id=message.board_boot_id or "",
            values=[],
        )
        made = self._make(_DIAGNOSTICS, header=self._header(message), status=[status])
        return RosMessage("diagnostics", _DIAGNOSTICS, message.t_ns, made)


def ros_name(text: str) -> str:
    """Return the text as a name that ROS takes: letters, digits and underscores, no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if re.match(r"[A-Za-z]", name) else f"plate_{name}"


def _moment(contact: Contact) -> tuple[float, float, float]:
    x, y = contact.position_m
    return y * contact.force_newton, -x * contact.force_newton, 0.0


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, str) else value
