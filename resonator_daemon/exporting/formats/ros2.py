"""A recording as an MCAP file that `ros2 bag` and viewers of ROS read: messages in CDR; no ROS is needed."""

import re
from collections.abc import Iterator
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from resonator_daemon.errors import UserError
from resonator_daemon.exporting.clouds import Clouds, Points
from resonator_daemon.exporting.mcap_output import McapOutput, cloud_fields, severity, state_text
from resonator_daemon.host.printable import how_to_install
from resonator_daemon.publishing.payloads import Contact, ContactEvent, Contacts, State
from resonator_daemon.publishing.topics import Topic

try:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
except ImportError as error:
    raise UserError(f"messages of ROS 2 need rosbags: {how_to_install('rosbags')}") from error

_CONTACT, _CONTACTS, _EVENT = (f"resonator_msgs/msg/{name}" for name in ("Contact", "Contacts", "ContactEvent"))
_WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
_CLOUD: Final = "sensor_msgs/msg/PointCloud2"
_DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"

# Keys of a contact that are numbers and vectors, in the order of the message; NaN where the plate has none.
_VECTORS: Final = ("force_newton", "noise_newton", "moment_newton_m", "moment_std_newton_m")
_NUMBERS: Final = (
    "systematic_newton",
    "at_least_newton",
    "slip_margin",
    "slip_margin_std",
    "friction_coefficient",
    "friction_coefficient_std",
)
_DEFINITIONS: Final = {
    _CONTACT: (
        "uint64 id",
        "uint32 site",
        "float64[2] position_m",
        "float64[3] position_covariance_m2",
        *(f"float64[3] {key}" for key in _VECTORS),
        *(f"float64 {key}" for key in _NUMBERS),
        "string status",
        "string reason_code",
    ),
    _CONTACTS: ("std_msgs/Header header", "string status", "string reason_code", f"{_CONTACT}[] contacts"),
    _EVENT: (
        "std_msgs/Header header",
        "string event",
        "string reason_code",
        "string reason",
        f"{_CONTACT} contact",
        "float64 peak_newton",
        "builtin_interfaces/Time since",
        "float64 duration_s",
    ),
}
_DATATYPES: Final = {"<u2": 4, "<f4": 7, "<f8": 8}  # UINT16, FLOAT32, FLOAT64 of sensor_msgs/PointField


class Format(McapOutput):
    """Messages of kinds that ROS has, under `/NAME/...`, and contacts in a kind that comes with the file.

    Coordinates are the plate's, whose frame has its name: x to the right, y downwards, z into the plate; metres.
    """

    profile = "ros2"
    schema_encoding = "ros2msg"
    message_encoding = "cdr"
    channel_metadata = MappingProxyType({"offered_qos_profiles": ""})

    def begin(self) -> None:
        super().begin()
        self._frame_id = ros_name(self._recorded.name)
        self.prefix = f"/{self._frame_id}/"
        self._clouds = Clouds(self._recorded.plate)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        for kind, lines in _DEFINITIONS.items():
            self._store.register(get_types_from_msg("\n".join(lines), kind))

    def put(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        for path, kind, fields in self._messages(topic.path, message):
            header = self._make("std_msgs/msg/Header", stamp=self._time(message.t_ns), frame_id=self._frame_id)
            data = bytes(self._store.serialize_cdr(self._make(kind, header=header, **fields), kind))
            definition = self._store.generate_msgdef(kind, ros_version=2)[0] if kind not in self._schemas else ""
            self.write(path, kind, definition, data, now_ns, message.t_ns)

    def _messages(self, path: str, message: Any) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Yield path, kind and fields of what a message becomes; nothing for kinds that ROS has no use for."""
        match message:
            case Contacts():
                contacts = message.contacts
                of_each = [self._contact(contact) for contact in contacts]
                fields = {
                    "status": str(message.status),
                    "reason_code": str(message.reason_code or ""),
                    "contacts": of_each,
                }
                yield path, _CONTACTS, fields
                yield "wrench", _WRENCH, self._wrench([_wrench_of(contact) for contact in contacts])
            case ContactEvent():
                contact = message.contact
                yield (
                    path,
                    _EVENT,
                    {
                        "event": str(message.event),
                        "reason_code": str(message.reason_code or ""),
                        "reason": message.reason or "",
                        "contact": self._contact(contact),
                        "peak_newton": contact.peak_newton,
                        "since": self._time(contact.since_t_ns),
                        "duration_s": contact.duration_s,
                    },
                )
            case State():
                yield "diagnostics", _DIAGNOSTICS, {"status": [self._diagnostic_status(path, message)]}
            case _:
                if (points := self._clouds.points(message)) is not None:
                    yield f"{path}/cloud", _CLOUD, self._cloud(points)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _time(self, t_ns: int) -> Any:
        sec, nanosec = divmod(t_ns, 10**9)
        return self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)

    def _contact(self, contact: Contact) -> Any:
        vectors = {key: getattr(contact, key) for key in _VECTORS}
        numbers = {key: getattr(contact, key) for key in _NUMBERS}
        return self._make(
            _CONTACT,
            id=contact.id or 0,
            site=contact.site,
            position_m=np.array(contact.position_m),
            position_covariance_m2=np.array(contact.position_covariance_m2),
            **{key: np.full(3, np.nan) if vector is None else np.array(vector) for key, vector in vectors.items()},
            **{key: np.nan if number is None else number for key, number in numbers.items()},
            status=str(contact.status),
            reason_code=str(contact.reason_code or ""),
        )

    def _wrench(self, wrenches: list[tuple[Any, Any]]) -> dict[str, Any]:
        """Return the sum of all contacts about the origin; NaN where that of one is not known."""
        force, torque = (
            self._make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, np.sum(parts, axis=0)), strict=True)))
            for parts in zip(((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), *wrenches, strict=True)
        )
        return {"wrench": self._make("geometry_msgs/msg/Wrench", force=force, torque=torque)}

    def _cloud(self, points: Points) -> dict[str, Any]:
        fields = cloud_fields(points, _DATATYPES, "datatype")
        return {
            "height": 1,
            "width": len(points),
            "fields": [self._make("sensor_msgs/msg/PointField", count=1, **field) for field in fields],
            "is_bigendian": False,
            "point_step": points.dtype.itemsize,
            "row_step": points.nbytes,
            "data": np.frombuffer(points.tobytes(), np.uint8),
            "is_dense": not any(np.isnan(points[name]).any() for name in points.dtype.names or ()),
        }

    def _diagnostic_status(self, path: str, message: State) -> Any:
        return self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=severity(message.state),
            name=f"{self._frame_id}: {path}",
            message=state_text(message),
            hardware_id=message.board_boot_id or "",
            values=[],
        )


def ros_name(text: str) -> str:
    """Return the text as a name that ROS takes: letters, digits and underscores, no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if re.match(r"[A-Za-z]", name) else f"plate_{name}"


def _wrench_of(contact: Contact) -> tuple[Any, Any]:
    """Return force and moment; of a force site those of its normal force."""
    if contact.moment_newton_m is not None:
        return contact.force_newton, contact.moment_newton_m
    (x, y), normal_newton = contact.position_m, contact.force_newton[2]
    return (0.0, 0.0, normal_newton), (y * normal_newton, -x * normal_newton, 0.0)
