"""Schemas of the channels that are made for viewers, as JSON Schema, and Foxglove's message types as plain data.

Foxglove, Lichtblick and PlotJuggler know the types by their names (https://docs.foxglove.dev/docs/visualization/message-schemas). Every
field of a type is given, also where it is empty: viewers rely on that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Json = dict[str, Any]

NUMBER: Json = {"type": "number"}
INTEGER: Json = {"type": "integer"}
TEXT: Json = {"type": "string"}
FLAG: Json = {"type": "boolean"}


def table(title: str, **fields: Json) -> Json:
    """An object of these fields."""
    return {"title": title, "type": "object", "properties": fields}


def _list(items: Json) -> Json:
    return {"type": "array", "items": items}


TIME = table("Time", sec=INTEGER, nsec=INTEGER)
DURATION = table("Duration", sec=INTEGER, nsec=INTEGER)
VECTOR = table("foxglove.Vector3", x=NUMBER, y=NUMBER, z=NUMBER)
QUATERNION = table("foxglove.Quaternion", x=NUMBER, y=NUMBER, z=NUMBER, w=NUMBER)
POSE = table("foxglove.Pose", position=VECTOR, orientation=QUATERNION)
COLOR = table("foxglove.Color", r=NUMBER, g=NUMBER, b=NUMBER, a=NUMBER)
POSE_IN_FRAME = table("foxglove.PoseInFrame", timestamp=TIME, frame_id=TEXT, pose=POSE)
TRANSFORM = table(
    "foxglove.FrameTransform", timestamp=TIME, parent_frame_id=TEXT, child_frame_id=TEXT, translation=VECTOR, rotation=QUATERNION
)
TRANSFORMS = table("foxglove.FrameTransforms", transforms=_list(TRANSFORM))
LOG = table("foxglove.Log", timestamp=TIME, level=INTEGER, message=TEXT, name=TEXT, file=TEXT, line=INTEGER)
_CUBE = table("foxglove.CubePrimitive", pose=POSE, size=VECTOR, color=COLOR)
_CYLINDER = table("foxglove.CylinderPrimitive", pose=POSE, size=VECTOR, bottom_scale=NUMBER, top_scale=NUMBER, color=COLOR)
_LINE = table(
    "foxglove.LinePrimitive", type=INTEGER, pose=POSE, thickness=NUMBER, scale_invariant=FLAG, points=_list(VECTOR), color=COLOR,
    colors=_list(COLOR), indices=_list(INTEGER),
)  # fmt: skip
_TEXT = table(
    "foxglove.TextPrimitive", pose=POSE, billboard=FLAG, font_size=NUMBER, scale_invariant=FLAG, color=COLOR, text=TEXT
)  # fmt: skip
_NONE: Json = _list({"type": "object", "properties": {}})
ENTITY = table(
    "foxglove.SceneEntity", timestamp=TIME, frame_id=TEXT, id=TEXT, lifetime=DURATION, frame_locked=FLAG,
    metadata=_list(table("foxglove.KeyValuePair", key=TEXT, value=TEXT)), arrows=_NONE, cubes=_list(_CUBE), spheres=_NONE,
    cylinders=_list(_CYLINDER), lines=_list(_LINE), triangles=_NONE, texts=_list(_TEXT), models=_NONE,
)  # fmt: skip
_DELETION = table("foxglove.SceneEntityDeletion", timestamp=TIME, type=INTEGER, id=TEXT)
SCENE = table("foxglove.SceneUpdate", deletions=_list(_DELETION), entities=_list(ENTITY))

MATCHING_ID = 0
"""Of a deletion."""
LINE_STRIP, LINE_LOOP = 0, 1
INFO, WARNING, ERROR = 2, 3, 4
"""Levels of a Log."""

Colour = tuple[float, float, float, float]


def time(ns: int) -> Json:
    """A time or a duration."""
    return {"sec": ns // 1_000_000_000, "nsec": ns % 1_000_000_000}


def vector(x: float, y: float, z: float = 0.0) -> Json:
    """A point or a displacement, m."""
    return {"x": float(x), "y": float(y), "z": float(z)}


def turned(angle: float) -> Json:
    """The rotation by this angle about the z axis, rad."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(angle / 2.0), "w": math.cos(angle / 2.0)}


def pose(x: float, y: float, z: float = 0.0, angle: float = 0.0) -> Json:
    """A place, m, and a heading, rad."""
    return {"position": vector(x, y, z), "orientation": turned(angle)}


def colour(given: Colour) -> Json:
    """Red, green, blue and opacity, 0 to 1."""
    return dict(zip("rgba", given, strict=True))


def cylinder(x: float, y: float, radius: float, height: float, given: Colour) -> Json:
    """An upright one that stands on the ground, m."""
    size = vector(2.0 * radius, 2.0 * radius, height)
    return {"pose": pose(x, y, height / 2.0), "size": size, "bottom_scale": 1.0, "top_scale": 1.0, "color": colour(given)}


def cube(x: float, y: float, side: float, height: float, given: Colour) -> Json:
    """A square block that stands on the ground, m."""
    return {"pose": pose(x, y, height / 2.0), "size": vector(side, side, height), "color": colour(given)}


def line(points: Sequence[tuple[float, float]], given: Colour, *, closed: bool = False, pixels: float = 2.0) -> Json:
    """A line on the ground."""
    kind = LINE_LOOP if closed else LINE_STRIP
    return {
        "type": kind, "pose": pose(0.0, 0.0), "thickness": pixels, "scale_invariant": True, "points": [vector(x, y) for x, y in points],
        "color": colour(given), "colors": [], "indices": [],
    }  # fmt: skip


def text(x: float, y: float, z: float, words: str, given: Colour) -> Json:
    """Words at a place, m, turned to whoever looks."""
    place = pose(x, y, z)
    return {"pose": place, "billboard": True, "font_size": 12.0, "scale_invariant": True, "color": colour(given), "text": words}


def entity(ns: int, frame: str, identity: str, parts: Mapping[str, list[Json]]) -> Json:
    """What a scene shows under one name until it is replaced. parts: `lines`, `cubes`, `cylinders`, `texts`."""
    empty: dict[str, list[Json]] = {
        name: [] for name in ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    }
    return {
        "timestamp": time(ns), "frame_id": frame, "id": identity, "lifetime": time(0), "frame_locked": False,
        "metadata": [], **empty, **parts,
    }  # fmt: skip
