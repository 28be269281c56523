"""JSON schemas of the messages that Foxglove draws: https://docs.foxglove.dev/docs/sdk/schemas, as far as used here.

Viewers recognise a schema by its title.
"""

import json
from pathlib import Path
from typing import Any, Final

from resonator_daemon.board.recording.reader import MARK_SCHEMA_DATA

Schema = dict[str, Any]

UINT16, FLOAT32, FLOAT64 = 3, 7, 8  # foxglove.PackedElementField.NumericType
NUMERIC_TYPES: Final = {"<u2": UINT16, "<f4": FLOAT32, "<f8": FLOAT64}
LINE_LOOP: Final = 1  # foxglove.LinePrimitive.LineType

# Viewers expect each list of an entity, empty ones too.
UNUSED_PRIMITIVES: Final = ("metadata", "cubes", "cylinders", "triangles", "models")

_BY_TITLE: Final[dict[str, Schema]] = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))

LOG: Final[Schema] = MARK_SCHEMA_DATA
FRAME_TRANSFORMS, GRID, POINT_CLOUD, SCENE_UPDATE = (
    _BY_TITLE[f"foxglove.{name}"] for name in ("FrameTransforms", "Grid", "PointCloud", "SceneUpdate")
)
WRENCHES: Final = _BY_TITLE["resonatord.Wrenches"]
"""Of each contact, about the plate's origin in newton and newton metre; for plots."""
