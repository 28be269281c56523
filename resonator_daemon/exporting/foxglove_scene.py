"""Drawings of a plate and its contacts as entities of `foxglove.SceneUpdate`."""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from resonator_daemon.exporting.foxglove_schemas import LINE_LOOP, UNUSED_PRIMITIVES
from resonator_daemon.exporting.geometry import Geometry
from resonator_daemon.exporting.wrenches import about_origin
from resonator_daemon.publishing.payloads import Contacts
from resonator_daemon.recording.reader import json_time

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
