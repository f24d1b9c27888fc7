"""Down a corridor along x without touching its walls.

Safety value: the least distance of the robot's disc from a wall over the run, m; >= 0 iff it never touched one. The law: it starts at
x = 0, y uniform where the clearance is at least `start_clearance`, all other states 0. Progress: how far it came along x, m. It is over
where x >= length; nothing counts after that.
"""

from typing import NamedTuple

import numpy as np

from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.tasks.parameters import columns_of, filled_in, require, whole


class Tally(NamedTuple):
    """(n,) each."""

    least: np.ndarray
    x: np.ndarray
    over: np.ndarray


class MyThing:
    """Interface: `s2r_runtime.hookspecs.Task`. Models with the states x, y."""

    name = "my_thing"
    PARAMETERS = {
        "half_width": (0.5, "from the middle to a wall, m"),
        "length": (1.0, "of the corridor, m"),
        "robot_radius": (0.1, "the robot's disc, m"),
        "start_clearance": (0.1, "clearance at the start at least, m"),
        "steps": (300, "horizon, steps of the model"),
        "min_progress": (0.8, "median of the progress, m, at least"),
    }

    def __init__(self, parameters, model, dt):
        p = self._p = filled_in(self.name, parameters, self.PARAMETERS)
        whole(self.name, p, 1, ("steps",))
        require(self.name, p, "half_width", p["half_width"] > p["robot_radius"] + p["start_clearance"], "wide enough to start in")
        for name in ("length", "robot_radius", "min_progress"):
            require(self.name, p, name, p[name] > 0.0, "> 0 m")
        self._x, self._y = columns_of(self.name, model, ("x", "y"))
        self._nx, self.horizon = len(model.states), int(p["steps"])
        self._room = p["half_width"] - p["robot_radius"] - p["start_clearance"]

    def draw(self, rng, n):
        start = np.zeros((n, self._nx))
        start[:, self._y] = rng.uniform(-self._room, self._room, n)
        return {"start": start}

    def draw_at(self, rng, x):
        if abs(x[self._y]) > self._room or x[self._x] >= self._p["length"]:
            raise NotEnoughEvidence(f"task {self.name}: scenarios start in the corridor, at most {self._room:g} m from its middle")
        return {"start": np.asarray(x, dtype=float)[None, :]}

    def advance(self, scenario, rng):
        return dict(scenario)  # nothing moves

    def view(self, scenario):
        """What a controller may see."""
        return {"half_width": np.full(len(scenario["start"]), self._p["half_width"])}

    def clearance(self, x, scenario):
        return self._p["half_width"] - self._p["robot_radius"] - np.abs(x[:, self._y])

    def begin(self, scenario):
        n = len(scenario["start"])
        return Tally(np.full(n, np.inf), scenario["start"][:, self._x], np.zeros(n, dtype=bool))

    def observe(self, tally, x, scenario):
        least = np.where(tally.over, tally.least, np.minimum(tally.least, self.clearance(x, scenario)))
        at = np.where(tally.over, tally.x, x[:, self._x])
        return Tally(least, at, tally.over | (at >= self._p["length"]))

    def safety(self, tally):
        return tally.least

    def progress(self, tally):
        return tally.x

    def done(self, tally):
        return tally.over

    def progress_ok(self, progress):
        return bool(np.median(progress) >= self._p["min_progress"])
