"""What stands around the robot, as Foxglove's scene entities: region, geofence, and the task's obstacles and goals.

A task says what a controller may see of a scenario (`Task.view`): arrays with a first axis of 1, under names of its own. These names are
drawn, whatever task gives them; all lengths in m:

    goal (1, 2), goals (1, k, 2)                            goals
    NAME (1, 2) with NAME_radius (1,)                       a disc to stay out of
    NAME_x, NAME_y (1,) or (1, k), NAME_radius if there     points, such as movers; a goal if NAME begins with `goal`
    blocked (1, rows, columns) with cell, left, bottom      blocked cells of a grid whose first row and column are its border
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from s2r_runtime.live import schemas
from s2r_runtime.live.schemas import Json

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from s2r_runtime.hookspecs import Scenario
    from s2r_runtime.messages import Settings

    Array = NDArray[np.float64]

FRAME = "map"
"""The frame in which the model's x and y are."""
GREEN, RED, BLUE, GREY = (0.1, 0.6, 0.3, 0.6), (0.8, 0.2, 0.2, 0.7), (0.1, 0.4, 0.8, 0.9), (0.4, 0.4, 0.4, 0.8)
POINT_M, HEIGHT_M, FLAT_M = 0.05, 0.1, 0.01
"""Radius of what has none, height of an obstacle, height of a goal."""


def bounds(settings: Settings, ns: int) -> list[Json]:
    """Region and geofence, where the model has x and y and both are bounded."""
    if not {"x", "y"} <= set(settings.states):
        return []
    x, y = settings.states.index("x"), settings.states.index("y")
    found = []
    for name, limits, colour in (("region", settings.region, BLUE), ("geofence", settings.geofence, RED)):
        if max(x, y) >= len(limits) or not all(map(math.isfinite, (*limits[x], *limits[y]))):
            continue
        (left, right), (bottom, top) = limits[x], limits[y]
        edge = schemas.line([(left, bottom), (right, bottom), (right, top), (left, top)], colour, closed=True)
        found.append(schemas.entity(ns, FRAME, name, {"lines": [edge], "texts": [schemas.text(left, top, 0.0, name, colour)]}))
    return found


def scenario(view: Scenario, ns: int) -> list[Json]:
    """Obstacles and goals of what a controller sees."""
    goals, obstacles, blocks = _goals(view), _discs(view), _blocks(view)
    for name in view:
        if name.endswith("_x") and f"{name[:-2]}_y" in view:
            (goals if name.startswith("goal") else obstacles).extend(_points(view, name[:-2]))
    return [
        schemas.entity(ns, FRAME, "goals", {"cylinders": goals}),
        schemas.entity(ns, FRAME, "obstacles", {"cylinders": obstacles, "cubes": blocks}),
    ]


def _goals(view: Scenario) -> list[Json]:
    found = [_pair(view[name]) for name in ("goal", "goals") if name in view]
    radius = _number(view, "goal_radius", POINT_M)
    return [schemas.cylinder(x, y, radius, FLAT_M, GREEN) for rows in found for x, y in rows]


def _discs(view: Scenario) -> list[Json]:
    found = []
    for name in view:
        if f"{name}_radius" in view and name not in {"goal", "goals"}:
            radius = _number(view, f"{name}_radius", POINT_M)
            found += [schemas.cylinder(x, y, radius, HEIGHT_M, RED) for x, y in _pair(view[name])]
    return found


def _points(view: Scenario, name: str) -> list[Json]:
    x, y = (np.atleast_1d(np.asarray(view[f"{name}_{axis}"], dtype=np.float64)[0]) for axis in "xy")
    radius, goal = _number(view, f"{name}_radius", POINT_M), name.startswith("goal")
    given = zip(x, y, strict=True) if x.shape == y.shape and x.ndim == 1 else ()
    height, colour = (FLAT_M, GREEN) if goal else (HEIGHT_M, RED)
    return [schemas.cylinder(a, b, radius, height, colour) for a, b in given if math.isfinite(a) and math.isfinite(b)]


def _blocks(view: Scenario) -> list[Json]:
    if not {"blocked", "cell", "left", "bottom"} <= set(view):
        return []
    cell, left, bottom = (_number(view, name, 1.0) for name in ("cell", "left", "bottom"))
    inner = np.asarray(view["blocked"])[0][1:-1, 1:-1]
    return [
        schemas.cube(left + (column + 0.5) * cell, bottom + (row + 0.5) * cell, cell, HEIGHT_M, GREY) for row, column in np.argwhere(inner)
    ]


def _pair(value: Any) -> list[tuple[float, float]]:
    """Rows of two finite numbers; nothing for any other shape."""
    array = np.asarray(value, dtype=np.float64)
    rows = array.reshape(-1, 2) if array.ndim in (2, 3) and array.shape[-1] == 2 else np.empty((0, 2))
    return [(float(x), float(y)) for x, y in rows if math.isfinite(x) and math.isfinite(y)]


def _number(view: Scenario, name: str, default: float) -> float:
    if name not in view:
        return default
    value = np.asarray(view[name], dtype=np.float64).ravel()
    return float(value[0]) if value.size and math.isfinite(value[0]) else default
