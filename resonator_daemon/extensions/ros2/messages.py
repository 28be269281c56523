"""Messages of a plate as messages of ROS 2, for files and for the bridge alike; no ROS is needed.

Types are those that come with ROS, and `resonator_msgs` for what ROS has no type for.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.errors import MissingLibraryError
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.extensions.viewer_support import (
    OK,
    WARN,
    Geometry,
    Points,
    about_origin,
    cloud_fields,
    severity,
    state_text,
)
from resonator_daemon.mqtt.payloads import (
    Contact,
    ContactEvent,
    Contacts,
    Decoded,
    DecodedSummary,
    Forces,
    Health,
    Message,
    Signals,
    State,
)
from resonator_daemon.mqtt.topics import HEALTH

try:
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.store import Typestore
except ImportError as error:
    raise MissingLibraryError(f"messages of ROS 2 need rosbags: {how_to_install('rosbags')}") from error

CONTACT, CONTACTS, EVENT, FORCES, SITE_FORCE, SUMMARY, PATCH = (
    f"resonator_msgs/msg/{name}"
    for name in ("Contact", "Contacts", "ContactEvent", "Forces", "SiteForce", "DecodedSummary", "Patch")
)
WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
CLOUD: Final = "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"

_DEFINITIONS: Final = Path(__file__).with_name("resonator_msgs") / "msg"  # fields have the names of the payloads' keys

DIAGNOSTICS_TOPIC: Final = "/diagnostics"

_TOPICS: Final = {
    "contacts": (("contacts", CONTACTS), ("wrench", WRENCH), ("contacts/wrench", WRENCH), ("/tf", TRANSFORMS)),
    "contacts/event": (("contacts/event", EVENT),),
    "forces": (("forces", FORCES), ("forces/cloud", CLOUD)),
    "signals": (("signals/cloud", CLOUD),),
    "decoded": (("decoded/cloud", CLOUD),),
    "decoded/summary": (("decoded/summary", SUMMARY),),
}
_DATATYPES: Final = {"<u2": 4, "<f4": 7, "<f8": 8}  # UINT16, FLOAT32, FLOAT64 of sensor_msgs/PointField
_NO_ROTATION: Final = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


class Translated(NamedTuple):
    """One message of ROS: topic, type as `geometry_msgs/msg/WrenchStamped`, and what makes it."""

    topic: str
    kind: str
    make: Callable[[], Any]


class Translation:
    """Translation of one plate's messages to those of ROS.

    Coordinates are the plate's: x to the right, y downwards, z into the plate; metres. Frames are the plate, with its
    name, and one at each contact, with parallel axes: `NAME_contact_0` and so on, numbered from the lowest free number.

    Parameters
    ----------
    name
        Name that the plate is published under.
    geometry
        Of the plate.
    namespace
        Before the names of topics: empty, or as `/hand`.
    store
        Types of the messages; the default is that of `make_typestore`.
    """

    def __init__(self, name: str, geometry: Geometry, namespace: str = "", store: Typestore | None = None) -> None:
        self.frame_id = ros_name(name)
        self._base = f"{namespace}/{self.frame_id}"
        self._geometry = geometry
        self._numbers: dict[int | None, int] = {}  # of the frames, by id of the contact
        self.store = store or make_typestore()
        self._types = self.store.types
        self._diagnostics = Diagnostics(name, self.store)
        self._converters: dict[str, tuple[tuple[str, Callable[[Any], Any]], ...]] = {}

    def topics(self, paths: Iterable[str]) -> dict[str, str]:
        """Return the topics that come of these topics below the plate, with their types."""
        return {self._topic(name): kind for path in paths for name, kind in _TOPICS.get(path, ())}

    def messages(self, path: str, message: Message) -> Iterator[Translated]:
        """Yield what a message becomes; nothing of kinds that ROS has no use for."""
        match message:
            case Contacts():
                frames = self._frames(message.contacts)
                yield self._translated(path, CONTACTS, partial(self._contacts, message, frames))
                yield self._translated("wrench", WRENCH, partial(self._sum, message))
                for contact, frame in zip(message.contacts, frames, strict=True):
                    make = partial(self._wrench_at, message.t_ns, contact, frame)
                    yield self._translated(f"{path}/wrench", WRENCH, make)
                if frames:
                    yield self._translated("/tf", TRANSFORMS, partial(self._transforms, message, frames))
            case ContactEvent():
                yield self._translated(path, EVENT, partial(self._event, message))
            case Forces():
                yield self._translated(path, FORCES, partial(self._forces, message))
                yield from self._clouded(path, message)
            case DecodedSummary():
                yield self._translated(path, SUMMARY, partial(self._summary, message))
            case State():
                status = self._diagnostics.of_state(path, message)
                make = partial(diagnostics_of, self.store, message.t_ns, [status])
                yield Translated(DIAGNOSTICS_TOPIC, DIAGNOSTICS, make)
            case Decoded() | Signals():
                yield from self._clouded(path, message)

    def encode(self, translated: Translated) -> bytes:
        """Return a message in CDR, with its encapsulation header."""
        return bytes(self.store.serialize_cdr(translated.make(), translated.kind))

    def _clouded(self, path: str, message: Message) -> Iterator[Translated]:
        if self._geometry.fits(message):  # else it is of another plate, of which no info has come
            yield self._translated(f"{path}/cloud", CLOUD, partial(self._cloud, message))

    def _translated(self, name: str, kind: str, make: Callable[[], Any]) -> Translated:
        return Translated(self._topic(name), kind, make)

    def _topic(self, name: str) -> str:
        return name if name.startswith("/") else f"{self._base}/{name}"

    def _frames(self, contacts: Iterable[Contact]) -> list[str]:
        """Return the frame of each contact; a contact keeps its number."""
        contacts = list(contacts)
        present = {contact.id for contact in contacts}
        self._numbers = {of: number for of, number in self._numbers.items() if of in present}
        numbers: list[int] = []
        for contact in contacts:
            taken = {*self._numbers.values(), *numbers}
            number = self._numbers.get(contact.id)
            if number is None:
                number = next(free for free in range(len(taken) + 1) if free not in taken)
            self._numbers[contact.id] = number
            numbers.append(number)
        return [f"{self.frame_id}_contact_{number}" for number in numbers]

    def _header(self, t_ns: int, frame_id: str | None = None) -> Any:
        frame_id = self.frame_id if frame_id is None else frame_id
        return self._types["std_msgs/msg/Header"](stamp=self._time(t_ns), frame_id=frame_id)

    def _time(self, t_ns: int) -> Any:
        sec, nanosec = divmod(t_ns, 10**9)
        return self._types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)

    def _filled(self, kind: str, payload: Message, **given: Any) -> Any:
        """Return a message of `resonator_msgs`, whose fields have the names of the payload's keys."""
        if kind not in self._converters:
            fields = self.store.fielddefs[kind][1]
            self._converters[kind] = tuple((name, _converter(field)) for name, field in fields if name not in given)
        values = {name: convert(getattr(payload, name)) for name, convert in self._converters[kind]}
        return self._types[kind](**values, **given)

    def _contacts(self, message: Contacts, frames: list[str]) -> Any:
        contacts = [
            self._filled(CONTACT, one, frame_id=frame) for one, frame in zip(message.contacts, frames, strict=True)
        ]
        return self._filled(CONTACTS, message, header=self._header(message.t_ns), contacts=contacts)

    def _event(self, message: ContactEvent) -> Any:
        contact, number = message.contact, self._numbers.get(message.contact.id)
        frame = "" if number is None else f"{self.frame_id}_contact_{number}"
        return self._filled(
            EVENT,
            message,
            header=self._header(message.t_ns),
            contact=self._filled(CONTACT, contact, frame_id=frame),
            peak_newton=contact.peak_newton,
            since=self._time(contact.since_t_ns),
            duration_s=contact.duration_s,
        )

    def _forces(self, message: Forces) -> Any:
        sites = [self._filled(SITE_FORCE, force) for force in message.sites]
        return self._filled(FORCES, message, header=self._header(message.t_ns), sites=sites)

    def _summary(self, message: DecodedSummary) -> Any:
        patches = [self._filled(PATCH, patch) for patch in message.patches]
        return self._filled(SUMMARY, message, header=self._header(message.t_ns), patches=patches)

    def _sum(self, message: Contacts) -> Any:
        """Return the sum of all contacts about the origin; NaN where that of one is not known."""
        total = sum((about_origin(contact) for contact in message.contacts), np.zeros((2, 3)))
        return self._wrench(self._header(message.t_ns), total)

    def _wrench_at(self, t_ns: int, contact: Contact, frame: str) -> Any:
        """Return the wrench of a contact about its own position."""
        force, moment = about_origin(contact)
        moment = moment - np.cross([*contact.position_m, 0.0], force)
        return self._wrench(self._header(t_ns, frame), (force, moment))

    def _wrench(self, header: Any, parts: Iterable[NDArray[np.float64]]) -> Any:
        make = self._types["geometry_msgs/msg/Vector3"]
        force, torque = (make(*part.tolist()) for part in parts)
        return self._types[WRENCH](
            header=header, wrench=self._types["geometry_msgs/msg/Wrench"](force=force, torque=torque)
        )

    def _transforms(self, message: Contacts, frames: list[str]) -> Any:
        types, header = self._types, self._header(message.t_ns)
        rotation = types["geometry_msgs/msg/Quaternion"](**_NO_ROTATION)
        return types[TRANSFORMS](
            transforms=[
                types["geometry_msgs/msg/TransformStamped"](
                    header=header,
                    child_frame_id=frame,
                    transform=types["geometry_msgs/msg/Transform"](
                        translation=types["geometry_msgs/msg/Vector3"](*contact.position_m, 0.0), rotation=rotation
                    ),
                )
                for contact, frame in zip(message.contacts, frames, strict=True)
            ]
        )

    def _cloud(self, message: Any) -> Any:
        points = cast(Points, self._geometry.points(message))  # kinds of the table have one
        make = self._types["sensor_msgs/msg/PointField"]
        return self._types[CLOUD](
            header=self._header(message.t_ns),
            height=1,
            width=len(points),
            fields=[make(count=1, **field) for field in cloud_fields(points, _DATATYPES, "datatype")],
            is_bigendian=False,
            point_step=points.dtype.itemsize,
            row_step=points.nbytes,
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=not any(np.isnan(points[name]).any() for name in points.dtype.names or ()),
        )


def _converter(field: Any) -> Callable[[Any], Any]:
    """Return what makes a value of a field; where there is none NaN, an empty text, or 0."""
    node, what = field
    if node is Nodetype.ARRAY:
        count = what[1]
        return lambda value: np.full(count, np.nan) if value is None else np.array(value, float)
    if what[0] == "string":
        return lambda value: "" if value is None else str(value)
    if what[0] == "float64":
        return lambda value: np.nan if value is None else value
    return lambda value: value or 0


STALE: Final = 3  # as diagnostic_msgs/DiagnosticStatus counts


class Diagnostics:
    """Translation of one plate's states and health to statuses.

    Parameters
    ----------
    name
        Name that the plate is published under.
    store
        Types of the messages.
    """

    def __init__(self, name: str, store: Typestore) -> None:
        self._name = name
        self._types = store.types

    def of_state(self, path: str, state: State) -> Any:
        """Return the status of daemon, link or sensor."""
        values = {"state": state.state, "reason_code": state.reason_code, "since_t_ns": state.since_t_ns}
        return self._status(path, severity(state.state), state_text(state), values)

    def of_health(self, health: Health, *, lost_more: bool) -> Any:
        """Return the status of the daemon's counters: a warning if losses grew, or a recording failed."""
        failure = health.recording.failure
        text = f"{health.frame_rate_hz:.0f} frames/s" + (", losses" if lost_more else "")
        if failure is not None:
            text += ", a recording failed"
        lost = {f"lost_{cause}": count for cause, count in health.lost.model_dump(exclude_none=True).items()}
        keys = ("frames", "frame_rate_hz", "frames_not_decoded", "uptime_s", "clock_drift_ppm", "cpu_percent", "rss_mb")
        values = {key: getattr(health, key) for key in keys} | lost
        return self._status(HEALTH.path, WARN if lost_more or failure is not None else OK, text, values)

    def _status(self, path: str, level: int, text: str, values: Mapping[str, Any]) -> Any:
        make = self._types["diagnostic_msgs/msg/KeyValue"]
        return self._types["diagnostic_msgs/msg/DiagnosticStatus"](
            level=level,
            name=f"{ros_name(self._name)}: {path}",
            message=text,
            hardware_id=self._name,
            values=[make(key=key, value="" if value is None else str(value)) for key, value in values.items()],
        )


def diagnostics_of(store: Typestore, t_ns: int, statuses: list[Any]) -> Any:
    """Return several statuses as one message."""
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(t_ns, 10**9))
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    return store.types[DIAGNOSTICS](header=header, status=statuses)


def make_typestore(*, humble: bool = False) -> Typestore:
    """Return the types of ROS 2 and `resonator_msgs`; with `humble`, ids of nodes have the length of Humble."""
    store = get_typestore(Stores.ROS2_HUMBLE if humble else Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for file in _DEFINITIONS.iterdir():
        types |= get_types_from_msg(file.read_text(), f"resonator_msgs/msg/{file.stem}")
    store.register(types)
    return store


def ros_name(text: str) -> str:
    """Return the text as a name that ROS accepts: letters, digits and underscores, no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return name if re.match(r"[A-Za-z]", name) else f"plate_{name}"
