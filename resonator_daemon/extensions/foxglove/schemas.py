"""JSON schemas of the messages that Foxglove draws: https://docs.foxglove.dev/docs/sdk/schemas, as far as used here.

Viewers recognise a schema by its title.
"""

from typing import Any, Final

from resonator_daemon.board.recording.reader import MARK_SCHEMA_DATA, TIME_SCHEMA

Schema = dict[str, Any]

UINT16, FLOAT32, FLOAT64 = 3, 7, 8  # foxglove.PackedElementField.NumericType
NUMERIC_TYPES: Final = {"<u2": UINT16, "<f4": FLOAT32, "<f8": FLOAT64}
LINE_LOOP: Final = 1  # foxglove.LinePrimitive.LineType


def _object(title: str = "", /, **properties: Schema) -> Schema:
    return ({"title": title} if title else {}) | {"type": "object", "properties": properties}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


_TEXT: Final = {"type": "string"}
_INTEGER: Final = {"type": "integer"}
_NUMBER: Final = {"type": "number"}
_KNOWN_OR_NULL: Final = {"type": ["number", "null"]}
_BOOLEAN: Final = {"type": "boolean"}
_BYTES: Final = {"type": "string", "contentEncoding": "base64"}
_VECTOR2: Final = _object(x=_NUMBER, y=_NUMBER)
_VECTOR: Final = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_PARTLY_KNOWN: Final = _object(x=_KNOWN_OR_NULL, y=_KNOWN_OR_NULL, z=_KNOWN_OR_NULL)
_QUATERNION: Final = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE: Final = _object(position=_VECTOR, orientation=_QUATERNION)
_COLOUR: Final = _object(r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_FIELDS: Final = _list(_object(name=_TEXT, offset=_INTEGER, type=_INTEGER))
_PLACED: Final[Schema] = {"timestamp": TIME_SCHEMA, "frame_id": _TEXT, "pose": _POSE}

LOG: Final[Schema] = MARK_SCHEMA_DATA
POINT_CLOUD: Final = _object("foxglove.PointCloud", **_PLACED, point_stride=_INTEGER, fields=_FIELDS, data=_BYTES)
GRID: Final = _object(
    "foxglove.Grid",
    **_PLACED,
    column_count=_INTEGER,
    cell_size=_VECTOR2,
    row_stride=_INTEGER,
    cell_stride=_INTEGER,
    fields=_FIELDS,
    data=_BYTES,
)
_TRANSFORM: Final = _object(
    timestamp=TIME_SCHEMA, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION
)
FRAME_TRANSFORMS: Final = _object("foxglove.FrameTransforms", transforms=_list(_TRANSFORM))
_ARROW: Final = _object(
    pose=_POSE,
    shaft_length=_NUMBER,
    shaft_diameter=_NUMBER,
    head_length=_NUMBER,
    head_diameter=_NUMBER,
    color=_COLOUR,
)
_SPHERE: Final = _object(pose=_POSE, size=_VECTOR, color=_COLOUR)
_LINE: Final = _object(
    type=_INTEGER,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_BOOLEAN,
    points=_list(_VECTOR),
    color=_COLOUR,
    colors=_list(_COLOUR),
    indices=_list(_INTEGER),
)
_LABEL: Final = _object(
    pose=_POSE, billboard=_BOOLEAN, font_size=_NUMBER, scale_invariant=_BOOLEAN, color=_COLOUR, text=_TEXT
)
# Viewers expect each list of an entity, empty ones too.
UNUSED_PRIMITIVES: Final = ("metadata", "cubes", "cylinders", "triangles", "models")
_ENTITY: Final = _object(
    timestamp=TIME_SCHEMA,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=TIME_SCHEMA,
    frame_locked=_BOOLEAN,
    arrows=_list(_ARROW),
    spheres=_list(_SPHERE),
    lines=_list(_LINE),
    texts=_list(_LABEL),
    **dict.fromkeys(UNUSED_PRIMITIVES, _list(_object())),
)
SCENE_UPDATE: Final = _object("foxglove.SceneUpdate", deletions=_list(_object()), entities=_list(_ENTITY))

_WRENCH: Final = _object(
    id={"type": ["integer", "null"]},
    site=_INTEGER,
    position=_PARTLY_KNOWN,
    force=_PARTLY_KNOWN,
    torque=_PARTLY_KNOWN,
    status=_TEXT,
)
WRENCHES: Final = _object("resonatord.Wrenches", timestamp=TIME_SCHEMA, frame_id=_TEXT, wrenches=_list(_WRENCH))
"""Of each contact, about the plate's origin in newton and newton metre; for plots."""
