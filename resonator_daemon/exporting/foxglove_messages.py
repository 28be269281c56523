"""Translation of messages to the channels that Foxglove shows, live and in recordings alike.

Each message has its own channel as JSON, and some have further ones: clouds, grids, arrows, wrenches, a log. Those with
arrays have only the latter.
"""

import base64
import json
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any, Final, NamedTuple

import numpy as np

from resonator_daemon.exporting import foxglove_scene
from resonator_daemon.exporting.clouds import Clouds, Points, map_values, on_grid, packed
from resonator_daemon.exporting.foxglove_scene import known_or_null, pose, vector
from resonator_daemon.exporting.foxglove_schemas import (
    FRAME_TRANSFORMS,
    GRID,
    LOG,
    NUMERIC_TYPES,
    POINT_CLOUD,
    SCENE_UPDATE,
    WRENCHES,
    Schema,
)
from resonator_daemon.exporting.geometry import Geometry
from resonator_daemon.exporting.mcap_output import cloud_fields, severity, state_text
from resonator_daemon.exporting.wrenches import about_origin
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.payloads import WITH_ARRAYS, Contacts, Decoded, Forces, Header, Message, Signals, State
from resonator_daemon.publishing.topics import TOPICS
from resonator_daemon.recording.reader import INFO_LEVEL, json_time, log_line

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
        self._clouds = None if geometry is None else Clouds(geometry.site_ids, geometry.sites_m)
        self._logged: dict[str, str] = {}  # by path

    def of_plate(self, t_ns: int) -> Iterator[ChannelMessage]:
        """Yield what stays the same while the plate does: its frame, outline and sites."""
        yield ChannelMessage("transforms", FRAME_TRANSFORMS, t_ns, partial(self._transforms, t_ns), True)
        if self._geometry is not None and self._clouds is not None:
            drawn = foxglove_scene.plate_entity(self._geometry, self._name, t_ns)
            yield ChannelMessage("plate/scene", SCENE_UPDATE, t_ns, partial(_scene, drawn), True)
            sites = self._clouds.sites()
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
        clouds = self._clouds
        if clouds is not None and clouds.fits(message) and (points := clouds.points(message)) is not None:
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
        return _scene(foxglove_scene.contacts_entity(message, self._geometry, self._name))


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
