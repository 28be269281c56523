"""Translation of messages to the channels that Foxglove shows, live and in recordings alike.

Each message has its own channel as JSON, and some have further ones: clouds, grids, arrows, wrenches, a log. Those with
arrays have only the latter.
"""

import base64
import json
import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Any, Final, NamedTuple

import numpy as np

from resonator_daemon.board.recording.reader import INFO_LEVEL, json_time, log_line
from resonator_daemon.extensions.foxglove.schemas import (
    FRAME_TRANSFORMS,
    GRID,
    LINE_LOOP,
    LOG,
    NUMERIC_TYPES,
    POINT_CLOUD,
    SCENE_UPDATE,
    UNUSED_PRIMITIVES,
    WRENCHES,
    Schema,
)
from resonator_daemon.extensions.viewer_support import (
    Geometry,
    Points,
    about_origin,
    cloud_fields,
    map_values,
    on_grid,
    packed,
    severity,
    state_text,
)
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.payloads import WITH_ARRAYS, Contacts, Decoded, Forces, Header, Message, Signals, State
from resonator_daemon.mqtt.topics import TOPICS

Entity = dict[str, Any]

_GREY: Final = {"r": 0.5, "g": 0.5, "b": 0.5, "a": 1.0}
_ORANGE: Final = {"r": 0.9, "g": 0.62, "b": 0.0, "a": 1.0}  # of Okabe and Ito, as vermilion
_VERMILION: Final = {"r": 0.84, "g": 0.37, "b": 0.0, "a": 1.0}
_IDENTITY: Final = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
# Parts of the plate's larger side.
_ARROW_AT_FORCE_MAX: Final = 1.0
_SHAFT, _HEAD_WIDTH, _HEAD_LENGTH, _TRANSDUCER = 0.01, 0.025, 0.04, 0.03
_FONT_PX: Final = 14.0


def plate_entity(geometry: Geometry, name: str, t_ns: int) -> Entity:
    """Return the outline as a line, and transducers as spheres."""
    outline = [vector(x, y, 0.0) for x, y in geometry.outline_m.tolist()]
    size = _TRANSDUCER * _side_m(geometry)
    line = {
        "type": LINE_LOOP,
        "pose": pose(),
        "thickness": 2.0,  # pixels
        "scale_invariant": True,
        "points": outline,
        "color": _GREY,
        "colors": [],
        "indices": [],
    }
    spheres = [
        {"pose": pose(x, y), "size": vector(size, size, size), "color": _GREY}
        for x, y in geometry.transducers_m.tolist()
    ]
    return entity("plate", name, t_ns) | {"lines": [line], "spheres": spheres}


def contacts_entity(message: Contacts, geometry: Geometry, name: str) -> Entity:
    """Return the force of each contact: an arrow that ends at its place, as long as the plate at its largest force.

    A contact whose force is not known has its status instead.
    """
    arrows, texts = [], []
    side_m = _side_m(geometry)
    for contact in message.contacts:
        place = np.array([*contact.position_m, 0.0])
        force = about_origin(contact)[0]
        size_newton = float(np.linalg.norm(force))
        tail, text = place, str(contact.status)
        if math.isfinite(size_newton):
            text = f"{size_newton:.2f} N"
            tail = place - force * (_ARROW_AT_FORCE_MAX * side_m / geometry.force_max_newton)
            if size_newton > 0 and np.isfinite(place).all():
                arrows.append(_arrow(tail, place, side_m))
        if np.isfinite(place).all():
            texts.append(_label(tail, f"{text}, site {contact.site}"))
    return entity("contacts", name, message.t_ns) | {"arrows": arrows, "texts": texts}


def entity(id: str, name: str, t_ns: int) -> Entity:
    """Return an empty entity in the frame of a plate; it replaces the one with its id."""
    lists: Entity = {key: [] for key in ("arrows", "spheres", "lines", "texts", *UNUSED_PRIMITIVES)}
    now, for_ever = json_time(t_ns), json_time(0)
    return {"timestamp": now, "frame_id": name, "id": id, "lifetime": for_ever, "frame_locked": True} | lists


def vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def known_or_null(values: Sequence[float]) -> dict[str, float | None]:
    return {axis: value if math.isfinite(value) else None for axis, value in zip("xyz", values, strict=True)}


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, rotation: dict[str, float] = _IDENTITY) -> dict[str, Any]:
    return {"position": vector(x, y, z), "orientation": rotation}


def _arrow(tail: Any, tip: Any, side_m: float) -> Entity:
    length_m = float(np.linalg.norm(tip - tail))
    head_m = min(_HEAD_LENGTH * side_m, length_m)
    x, y, z = tail.tolist()
    return {
        "pose": pose(x, y, z, _from_x_to((tip - tail) / length_m)),
        "shaft_length": length_m - head_m,
        "shaft_diameter": _SHAFT * side_m,
        "head_length": head_m,
        "head_diameter": _HEAD_WIDTH * side_m,
        "color": _VERMILION,
    }


def _label(place: Any, text: str) -> Entity:
    return {
        "pose": pose(*place.tolist()),
        "billboard": True,
        "font_size": _FONT_PX,
        "scale_invariant": True,
        "color": _ORANGE,
        "text": text,
    }


def _from_x_to(direction: Any) -> dict[str, float]:
    """Return the shortest rotation of the x axis to a unit vector, as a quaternion."""
    x, y, z = direction.tolist()
    turn = np.array([0.0, -z, y, 1.0 + x]) if x > -1 + 1e-12 else np.array([0.0, 0.0, 1.0, 0.0])  # x cross direction
    return dict(zip("xyzw", (turn / np.linalg.norm(turn)).tolist(), strict=True))


def _side_m(geometry: Geometry) -> float:
    return float(np.ptp(geometry.outline_m, axis=0).max())


_DRAWN: Final = {schema["title"] for schema in (POINT_CLOUD, GRID, SCENE_UPDATE)}
_UPSIDE_DOWN: Final = {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}  # by 180 degrees about x


class ChannelMessage(NamedTuple):
    """A message of one channel; `encode` makes its JSON, and one that is `lasting` is true until the next one."""

    channel: str
    schema: Schema
    t_ns: int
    encode: Callable[[], bytes]
    lasting: bool = False


class FoxgloveMessages:
    """Translation of one plate's messages to those of its channels.

    Parameters
    ----------
    name
        Name of the plate, and of its frame of coordinates.
    geometry
        None where it is not known yet: then nothing is drawn.
    """

    def __init__(self, name: str, geometry: Geometry | None) -> None:
        self._name = name
        self._geometry = geometry
        self._logged: dict[str, str] = {}  # by path

    def of_plate(self, t_ns: int) -> Iterator[ChannelMessage]:
        """Yield what stays the same while the plate does: its frame, outline and sites."""
        yield ChannelMessage("transforms", FRAME_TRANSFORMS, t_ns, partial(self._transforms, t_ns), True)
        if self._geometry is not None:
            drawn = plate_entity(self._geometry, self._name, t_ns)
            yield ChannelMessage("plate/scene", SCENE_UPDATE, t_ns, partial(_scene, drawn), True)
            sites = self._geometry.site_points()
            yield ChannelMessage("sites/cloud", POINT_CLOUD, t_ns, partial(self._cloud, sites, t_ns), True)

    def of_message(self, path: str, message: Message, now_ns: int) -> Iterator[ChannelMessage]:
        """Yield the channels' messages of a message of the topic `path`, published at `now_ns` (UTC)."""
        t_ns = message.t_ns if isinstance(message, Header) else now_ns
        if not isinstance(message, WITH_ARRAYS):
            yield ChannelMessage(path, schema_of(path), t_ns, partial(encode, message), TOPICS[path].retained)
        match message:
            case State():
                level, text = INFO_LEVEL + severity(message.state), state_text(message)
                if self._logged.get(path) == text:  # a state that is only published again
                    return
                self._logged[path] = text
                yield ChannelMessage("log", LOG, t_ns, partial(log_line, t_ns, level, path, text), True)
            case Contacts():
                yield ChannelMessage(f"{path}/wrenches", WRENCHES, t_ns, partial(self._wrenches, message))
                if self._geometry is not None:
                    yield ChannelMessage(f"{path}/scene", SCENE_UPDATE, t_ns, partial(self._contacts, message))
            case Decoded() if on_grid(message):
                yield ChannelMessage(f"{path}/grid", GRID, t_ns, partial(self._grid, message))
        plate = self._geometry
        if plate is not None and plate.fits(message) and (points := plate.points(message)) is not None:
            yield ChannelMessage(f"{path}/cloud", POINT_CLOUD, t_ns, partial(self._cloud, points, t_ns))

    def emptied(self, path: str, message: Message, now_ns: int) -> Iterator[ChannelMessage]:
        """Yield drawings that replace those of an earlier message, once what it measured is no longer known."""
        now = {"t_ns": now_ns}
        match message:
            case Forces():
                empty: Message = message.model_copy(update=now | {"sites": ()})
            case Contacts():
                empty = message.model_copy(update=now | {"contacts": ()})
            case Signals() | Decoded():
                arrays = {key: np.full_like(part, np.nan) for key, part in message if isinstance(part, np.ndarray)}
                empty = message.model_copy(update=now | arrays)
            case _:
                return
        yield from (made for made in self.of_message(path, empty, now_ns) if made.schema["title"] in _DRAWN)

    def _transforms(self, t_ns: int) -> bytes:
        turned = {
            "timestamp": json_time(t_ns),
            "parent_frame_id": f"{self._name}/z_up",
            "child_frame_id": self._name,
            "translation": vector(0.0, 0.0, 0.0),
            "rotation": _UPSIDE_DOWN,
        }
        return _json({"transforms": [turned]})

    def _cloud(self, points: Points, t_ns: int) -> bytes:
        place = {"timestamp": json_time(t_ns), "frame_id": self._name, "pose": pose()}
        return _json(place | {"point_stride": points.dtype.itemsize} | _packed_fields(points))

    def _grid(self, message: Decoded) -> bytes:
        assert message.grid is not None  # noqa: S101 - for the type checker
        rows, columns = message.traction_pascal.shape[1:]
        (x, y), pitch = message.grid.origin_m, message.grid.pitch_m
        cells = packed(map_values(message), rows * columns)
        return _json(
            {
                "timestamp": json_time(message.t_ns),
                "frame_id": self._name,
                "pose": pose(x - pitch / 2, y - pitch / 2),  # the corner of the first pixel
                "column_count": columns,
                "cell_size": {"x": pitch, "y": pitch},
                "row_stride": columns * cells.dtype.itemsize,
                "cell_stride": cells.dtype.itemsize,
            }
            | _packed_fields(cells)
        )

    def _wrenches(self, message: Contacts) -> bytes:
        wrenches = []
        for contact in message.contacts:
            force, torque = about_origin(contact).tolist()
            wrenches.append(
                {
                    "id": contact.id,
                    "site": contact.site,
                    "position": known_or_null((*contact.position_m, 0.0)),
                    "force": known_or_null(force),
                    "torque": known_or_null(torque),
                    "status": str(contact.status),
                }
            )
        return _json({"timestamp": json_time(message.t_ns), "frame_id": self._name, "wrenches": wrenches})

    def _contacts(self, message: Contacts) -> bytes:
        assert self._geometry is not None  # noqa: S101 - for the type checker
        return _scene(contacts_entity(message, self._geometry, self._name))


@cache
def schema_of(path: str) -> Schema:
    """Return the JSON schema of a topic's payload."""
    return TOPICS[path].payload.model_json_schema(mode="serialization")


def _scene(entity: dict[str, Any]) -> bytes:
    return _json({"deletions": [], "entities": [entity]})


def _packed_fields(values: Points) -> dict[str, Any]:
    data = base64.b64encode(values.tobytes()).decode()
    return {"fields": cloud_fields(values, NUMERIC_TYPES, "type"), "data": data}


def _json(value: Any) -> bytes:
    return json.dumps(value, allow_nan=False).encode()
