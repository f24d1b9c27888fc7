"""The quadruped's body: rigid bodies, contacts and motors at 1 kHz, and what can be wrong with them.

    x        position 3, quaternion 4, joints 12; velocities 6 + 12: the 37 numbers of `joints()`
    M_x      (x, y, theta) of the trunk, theta = atan2 of its forward axis on the floor, in (-pi, pi]
    M_u      `quadruped_gait`: forward speed and yaw rate to twelve servo commands, once a millisecond
    slope    gravity is tilted instead of the floor: floor coordinates lie in the slope
    fallen   the trunk is lower than FALLEN_M, or its up axis leans by more than 37 degrees (cosine below FALLEN_UP): it lies, or sits

One seed gives one robot: gait phase, stride jitter, sensor noise and shoves have generators of their own. Physics by MuJoCo (extra `sim`);
the same bits on one machine and version of it.
"""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from s2r_standins.faults import Pose, Twist
from s2r_standins.quadruped_faults import Fault, parse_fault
from s2r_standins.quadruped_gait import HEIGHT, Gait, Sensed
from s2r_standins.quadruped_sheet import QuadrupedSheet

XML = Path(__file__).parent / "data" / "quadruped.xml"
STEP_NS = 1_000_000
GRAVITY = 9.81
FALLEN_M, FALLEN_UP = 0.18, 0.8
LOOK_EVERY = 10
"""ms between looks whether it fell."""
SHOVE_MS = 100
SETTLE_MS = 300
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
"""All that the physics go on from: positions, velocities, forces applied from outside, and where the solver starts."""


class QuadrupedState(NamedTuple):
    """A robot at one time, as a value. Effects are no part of it."""

    k: int
    physics: bytes
    gait: tuple[Any, ...]
    generators: tuple[Any, ...]
    acting: Twist
    pending: tuple[tuple[int, Twist], ...]
    shove: tuple[int, int]
    fallen: str


class Quadruped:
    """Stands still at `start` when made. `k`: periods of the link since then."""

    def __init__(self, sheet: QuadrupedSheet | None = None, start: Pose = (0.0, 0.0, 0.0), seed: int = 1) -> None:
        self.sheet = sheet or QuadrupedSheet()
        self.model = mujoco.MjModel.from_xml_path(str(XML))
        self.data = mujoco.MjData(self.model)
        self._pristine = mujoco.MjModel.from_xml_path(str(XML))
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._base, self._angles, self._turning = self._qpos[3:7], self._qpos[7:19], self._qvel[3:6]
        self._trunk = self.model.body("trunk").id
        self._push = self.data.xfrc_applied[self._trunk]
        self._faults: dict[str, Fault] = {}
        self._up_floor = (0.0, 0.0, 1.0)
        self._delay_ms = 0
        self._shoves = (0.0, 0.0)
        self.reset(seed, start)

    def reset(self, seed: int, start: Pose = (0.0, 0.0, 0.0)) -> None:
        """A robot of this seed, standing at `start`, its clock at 0. Effects stay on."""
        self._ms = 0
        self._noise, self._stride, self._fate = (random.Random(f"{seed}/{what}") for what in ("noise", "gait", "shoves"))
        self._gait = Gait(self._stride)
        self._acting: Twist = (0.0, 0.0)
        self._pending: list[tuple[int, Twist]] = []
        self.fallen = ""
        self._shove = (2**62, 2**62)
        mujoco.mj_resetData(self.model, self.data)
        self._qpos[2] = HEIGHT + self.model.geom("front_left_foot").size[0]
        for leg, angles in enumerate(self._gait.stance()):
            self._angles[3 * leg : 3 * leg + 3] = angles
        for _ in range(SETTLE_MS):
            self._tick()
        self._ms = 0
        self.place(*start)
        self._draw_shove()

    # ------------------------------------------------------------------ as a stand-in's body

    @property
    def k(self) -> int:
        """Whole periods of the link since the start."""
        return self._ms // round(1000.0 * self.sheet.dt)

    @property
    def period_s(self) -> float:
        """The period of its link, s."""
        return self.sheet.dt

    @property
    def now_s(self) -> float:
        """Its clock, s."""
        return self._ms / 1000.0

    @property
    def trouble(self) -> str:
        """Why its state can't be told; empty while it stands."""
        return self.fallen

    def observe(self) -> Pose:
        """The pose as the cameras see it."""
        x, y, theta = self.pose()
        gauss, position = self._noise.gauss, self.sheet.sigma_position
        return x + gauss(0.0, position), y + gauss(0.0, position), _wrapped(theta + gauss(0.0, self.sheet.sigma_heading))

    def move(self, command: Twist) -> None:
        """One period of the link under this command."""
        self.step(*command, self.sheet.dt)

    # ------------------------------------------------------------------ walking

    def step(self, v: float, w: float, seconds: float = 0.1) -> Pose:
        """Walks for `seconds` (whole ms) under this command, clipped to the sheet's limits; where it then is. What fell stays down."""
        v = min(max(v, -self.sheet.v_max), self.sheet.v_max)
        w = min(max(w, -self.sheet.w_max), self.sheet.w_max)
        at = self._ms + self._delay_ms
        self._pending = [*(entry for entry in self._pending if entry[0] < at), (at, (v, w))]
        end = self._ms + round(1000.0 * seconds)
        while self._ms < end:
            if self._pending and self._pending[0][0] <= self._ms:
                self._acting = self._pending.pop(0)[1]
            if self._ms >= self._shove[0]:
                self._be_shoved()
            self._tick()
            if self._ms % LOOK_EVERY == 0 and not self.fallen:
                self._look()
        return self.pose()

    def _tick(self) -> None:
        """One millisecond."""
        if self.fallen:
            self._ctrl[:] = self._angles  # the servos let go and only brake
        else:
            a, b, c, d = self._base.tolist()
            ux, uy, uz = self._up_floor
            up_x = (a * a + b * b - c * c - d * d) * ux + 2.0 * (b * c + a * d) * uy + 2.0 * (b * d - a * c) * uz
            up_y = 2.0 * (b * c - a * d) * ux + (a * a - b * b + c * c - d * d) * uy + 2.0 * (c * d + a * b) * uz
            gx, gy, gz = self._turning.tolist()
            sensed = Sensed(up_x, up_y, (gx, gy, gz), self._angles.tolist())
            v, w = self._acting
            self._ctrl[:] = self._gait.step(v, w, sensed)
        mujoco.mj_step(self.model, self.data)
        self._ms += 1

    def _look(self) -> None:
        height, (_, b, c, _) = float(self._qpos[2]), self._base.tolist()
        up = 1.0 - 2.0 * (b * b + c * c)
        if not (height >= FALLEN_M and up >= FALLEN_UP):  # also true for NaN
            self.fallen = f"fell: trunk at {height:.2f} m, leaning {math.degrees(math.acos(min(max(up, -1.0), 1.0))):.0f} degrees"

    # ------------------------------------------------------------------ its state

    def pose(self) -> Pose:
        """(x, y, theta) of the trunk, as it is."""
        x, y = self._qpos[:2].tolist()
        a, b, c, d = self._base.tolist()
        return x, y, math.atan2(2.0 * (b * c + a * d), a * a + b * b - c * c - d * d)

    def joints(self) -> list[float]:
        """The whole mechanical state, 37 numbers: position, quaternion, joint angles; velocities of the trunk and of the joints."""
        return [*self._qpos.tolist(), *self._qvel.tolist()]

    def state(self) -> QuadrupedState:
        """Everything from which it goes on, to the bit."""
        physics = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, physics, STATE)
        generators = (self._noise.getstate(), self._stride.getstate(), self._fate.getstate())
        pending = tuple(self._pending)
        return QuadrupedState(self._ms, physics.tobytes(), self._gait.memory(), generators, self._acting, pending, self._shove, self.fallen)

    def restore(self, state: QuadrupedState) -> None:
        """Goes on from there. Effects stay as they are now."""
        self._ms, physics, gait, generators, self._acting, pending, self._shove, self.fallen = state
        mujoco.mj_setState(self.model, self.data, np.frombuffer(physics), STATE)
        self._gait.recall(gait)
        self._pending = list(pending)
        for generator, memory in zip((self._noise, self._stride, self._fate), generators, strict=True):
            generator.setstate(memory)

    def place(self, x: float, y: float, theta: float) -> None:
        """Moves it, its motion and its gait as one rigid thing, to this pose: a start state need not be walked to."""
        before = self.pose()
        half = 0.5 * (theta - before[2])
        self._qpos[:2] = x, y
        a, b, c, d = self._base.tolist()
        cos, sin = math.cos(half), math.sin(half)
        self._base[:] = cos * a - sin * d, cos * b - sin * c, cos * c + sin * b, cos * d + sin * a
        cos, sin = math.cos(2.0 * half), math.sin(2.0 * half)
        for vector in (self._qvel, self.data.qacc_warmstart):  # of the trunk: along the floor's axes; its turning is in its own
            ahead, left = float(vector[0]), float(vector[1])
            vector[:2] = cos * ahead - sin * left, sin * ahead + cos * left

    # ------------------------------------------------------------------ what is wrong with it

    def check(self, text: str) -> None:
        """Raises ConfigError if this is no effect that it can have."""
        parse_fault(text)

    def switch_on(self, text: str) -> str:
        """Begins an effect now; one of the same name (and leg) is replaced. Returns what it is. Raises ConfigError."""
        fault = parse_fault(text)
        self._faults[fault.key] = fault
        self._apply()
        return fault.key

    def clear(self) -> None:
        """Ends all effects."""
        self._faults = {}
        self._apply()

    def _apply(self) -> None:
        """The model as it was made, then every effect."""
        model, pristine = self.model, self._pristine
        payload = pristine.body("payload").id
        for name in ("body_mass", "body_inertia", "body_ipos", "geom_friction", "geom_pos", "geom_rgba", "actuator_gainprm"):
            getattr(model, name)[:] = getattr(pristine, name)
        for name in ("actuator_biasprm", "actuator_forcerange"):
            getattr(model, name)[:] = getattr(pristine, name)
        self._up_floor, self._delay_ms, shoves = (0.0, 0.0, 1.0), 0, (0.0, 0.0)
        for fault in self._faults.values():
            p = fault.values
            if fault.name == "payload":
                box = model.geom("payload")
                model.body_mass[payload] += p["mass"]
                model.body_ipos[payload][:2] = box.pos[:2] = p["x"], p["y"]
                sx, sy, sz = box.size
                model.body_inertia[payload] += p["mass"] / 3.0 * np.array([sy * sy + sz * sz, sx * sx + sz * sz, sx * sx + sy * sy])
                box.rgba[3] = 1.0
            elif fault.name == "floor":
                model.geom("floor").friction[0] = p["friction"]
            elif fault.name == "slope":
                lean = math.sin(p["angle"])
                self._up_floor = (lean * math.cos(p["direction"]), lean * math.sin(p["direction"]), math.cos(p["angle"]))
            elif fault.name == "weak_leg":
                motors = slice(3 * fault.leg, 3 * fault.leg + 3)
                for table in (model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange):
                    table[motors] *= p["strength"]
            elif fault.name == "latency":
                self._delay_ms = round(1000.0 * p["delay"])
            else:
                shoves = (p["force"], p["rate"])
        model.opt.gravity[:] = [-GRAVITY * part for part in self._up_floor]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        if shoves != self._shoves:
            self._shoves = shoves
            self._draw_shove()

    def _draw_shove(self) -> None:
        self._push[:3] = 0.0
        wait = self._fate.expovariate(self._shoves[1]) if self._shoves[1] > 0.0 else math.inf
        begin = self._ms + round(1000.0 * wait) if wait < 1e9 else 2**62
        self._shove = (begin, 2**62)

    def _be_shoved(self) -> None:
        """A shove begins or ends."""
        begin, end = self._shove
        if end <= self._ms:
            self._draw_shove()
        elif begin <= self._ms:
            angle = self._fate.uniform(-math.pi, math.pi)
            self._push[:2] = self._shoves[0] * math.cos(angle), self._shoves[0] * math.sin(angle)
            self._shove = (self._ms + SHOVE_MS, self._ms + SHOVE_MS)


def _wrapped(angle: float) -> float:
    """To (-pi, pi]."""
    angle = math.remainder(angle, 2.0 * math.pi)
    return angle if angle > -math.pi else math.pi
