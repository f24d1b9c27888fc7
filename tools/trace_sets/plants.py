"""The robots of the test data, in continuous time: what moves, and how, when nothing is missing from the model.

A plant takes what acts (a, one number an input) over a small part h of a step and moves its state x, a plain list:

    pose plants       a -> twist q = [v, w, side, east, north]: speed ahead m/s, yaw rate rad/s, speed to the left m/s, drift along the
                      world's axes m/s.   x += h (v cos - side sin + east), y += h (v sin + side cos + north), theta += h w, with the
                      heading in the middle of the part (arcs), or the one at the start of the recorded step (`frozen`: Euler's rule)
    force plants      a -> acceleration q, one an axis.   p += h (v + v')/2,  v' = v + h q less dry friction, which stops but never turns

States, inputs and parameters are named as in docs/recordings.md; the formulas are written here a second time on purpose.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trace_sets.world import Moment

Numbers = list[float]


@dataclass(frozen=True)
class Plant:
    """`reached`: states that follow an input at once, state index -> input index. velocity: indices of velocity states.

    move: moves the state in place by (plant, x, a, h, moment), of a robot that is neither of the two; file: its nominal model.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: dict[str, float] = field(default_factory=dict)
    reached: dict[int, int] = field(default_factory=dict)
    velocity: tuple[int, ...] = ()
    move: Callable[[Plant, Numbers, Numbers, float, Moment], None] | None = None
    file: str = ""

    @property
    def pose(self) -> bool:
        """Whether it has a heading."""
        return "theta" in self.states

    @property
    def axes(self) -> int:
        """Axes of a force plant."""
        return len(self.velocity)


def unicycle() -> Plant:
    """Inputs v, w."""
    return Plant("unicycle", ("x", "y", "theta"), ("v", "w"))


def differential_drive(wheel_radius: float, track: float) -> Plant:
    """Inputs are wheel speeds, which are measured too."""
    return Plant(
        "differential_drive",
        ("x", "y", "theta", "wheel_left", "wheel_right"),
        ("cmd_left", "cmd_right"),
        {"wheel_radius": wheel_radius, "track": track},
        {3: 0, 4: 1},
    )


def bicycle(wheel_base: float) -> Plant:
    """About the rear axle."""
    return Plant("bicycle", ("x", "y", "theta", "speed"), ("steer_cmd", "speed_cmd"), {"wheel_base": wheel_base}, {3: 1})


def double_integrator() -> Plant:
    """In the plane, inputs are accelerations."""
    return Plant("double_integrator", ("x", "y", "vx", "vy"), ("ax", "ay"), velocity=(2, 3))


def joint(mass: float) -> Plant:
    """One axis, the input is a force."""
    return Plant("joint", ("q", "qd"), ("force",), {"mass": mass}, velocity=(1,))


def twist(plant: Plant, a: Numbers) -> Numbers:
    """What a pose plant does of itself."""
    if plant.name == "unicycle":
        return [a[0], a[1], 0.0, 0.0, 0.0]
    if plant.name == "differential_drive":
        radius = plant.parameters["wheel_radius"]
        return [0.5 * radius * (a[0] + a[1]), radius * (a[1] - a[0]) / plant.parameters["track"], 0.0, 0.0, 0.0]
    return [a[1], a[1] * math.tan(a[0]) / plant.parameters["wheel_base"], 0.0, 0.0, 0.0]


def move_pose(x: Numbers, q: Numbers, h: float, frozen: float | None) -> None:
    """In place."""
    heading = x[2] + 0.5 * h * q[1] if frozen is None else frozen
    c, s = math.cos(heading), math.sin(heading)
    if frozen is None:  # the chord of the arc is shorter than the arc
        half = 0.5 * h * q[1]
        h_chord = h * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    else:
        h_chord = h
    x[0] += h_chord * (q[0] * c - q[2] * s) + h * q[3]
    x[1] += h_chord * (q[0] * s + q[2] * c) + h * q[4]
    x[2] += h * q[1]


def move_masses(plant: Plant, x: Numbers, a: Numbers, h: float, moment: Moment) -> None:
    """In place; forces are taken in the middle of the part."""
    n = plant.axes
    mass = plant.parameters.get("mass", 1.0)
    free = [value / mass for value in a]
    q = list(free)
    effects = moment.world.plant_effects
    if effects:
        for e in effects:
            e.push(moment, x, q)
        middle = [x[j] + 0.5 * h * x[n + j] for j in range(n)] + [x[n + j] + 0.5 * h * q[j] for j in range(n)]
        q = list(free)
        for e in effects:
            e.push(moment, middle, q)
    for j in range(n):
        before = x[n + j]
        after = before + h * q[j]
        for e in effects:
            limit = h * e.dry(moment, x, j, after)
            after -= math.copysign(min(abs(after), limit), after)
        x[j] += 0.5 * h * (before + after)
        x[n + j] = after
