"""The family `newer`: one of the library's newer effects that matters (nominal/oracle >= 3), or nothing missing on the same robots.

Wheels of unequal radius, a castor, rear tyres, ratio and offset of a steering, track width; of a joint: gravity on the link, friction with
the load and at rest, torque ripple, backlash of the gear. Values by docs/effects.md, sizes in proportion to the robot's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trace_sets.making import EXACT, Draft, Missing, common, draw_law, draw_noise, realise
from trace_sets.recording import TraceSet
from trace_sets.scale import Scale, draw_scale, log_uniform
from trace_sets.sizing import Band, sized

Rng = np.random.Generator
Values = dict[str, Any]

LARGE = Band(3.0, 1e9, 3.3, 40.0)
CLEAN_SHARE = 0.25
CASTOR = str(Path(__file__).with_name("castor_drive.py"))


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _wheels(rng: Rng, s: Scale, size: float) -> Values:
    """One wheel is off, or both by opposite shares."""
    off = min(size * float(rng.uniform(0.03, 0.15)), 0.6) * _sign(rng)
    left, right = (1.0 + off, 1.0) if rng.random() < 0.5 else (1.0, 1.0 + off)
    if rng.random() < 0.4:
        left, right = 1.0 + off, 1.0 - off * float(rng.uniform(0.3, 1.0))
    track = {} if "track" in s.plant.parameters else {"track": 2.0 * s.speed / s.yaw * log_uniform(rng, 0.5, 2.0)}
    return {"left": left, "right": right, **track}


def _castor(rng: Rng, s: Scale, size: float) -> Values:
    return {"loss": min(size * float(rng.uniform(0.03, 0.2)), 0.5) * s.speed, "arm": s.plant.parameters["castor"]}


def _rear(rng: Rng, s: Scale, size: float) -> Values:
    return {"coefficient": min(size * float(rng.uniform(0.1, 0.4)), 1.0) / (s.speed * max(s.yaw, 0.2))}


def _ratio(rng: Rng, s: Scale, size: float) -> Values:
    return {"ratio": 1.0 + min(size * float(rng.uniform(0.1, 0.4)), 0.7) * _sign(rng)}


def _offset(rng: Rng, s: Scale, size: float) -> Values:
    return {"angle": min(size * float(rng.uniform(0.05, 0.3)), 0.8) * s.ranges[0].size * _sign(rng)}


def _track(rng: Rng, s: Scale, size: float) -> Values:
    return {"gain": 1.0 + min(size * float(rng.uniform(0.05, 0.3)), 0.6) * _sign(rng)}


def _gravity(rng: Rng, s: Scale, size: float) -> Values:
    return {"torque": min(size * float(rng.uniform(0.15, 0.5)), 0.7) * s.ranges[0].size, "angle": float(rng.uniform(-3.1, 3.1))}


def _ripple(rng: Rng, s: Scale, size: float) -> Values:
    """Some periods in a usual move, and six samples a period at least."""
    period = max(s.speed * s.pace / float(rng.uniform(1.5, 6.0)), 6.0 * s.speed * s.dt)
    amplitude = min(size * float(rng.uniform(0.1, 0.4)), 0.8) * s.ranges[0].size
    return {"amplitude": amplitude, "period": period, "phase": float(rng.uniform(-3.1, 3.1))}


def _load(rng: Rng, s: Scale, size: float) -> Values:
    return {"coefficient": min(size * float(rng.uniform(0.1, 0.4)), 0.8)}


def _static(rng: Rng, s: Scale, size: float) -> Values:
    return {"force": min(size * float(rng.uniform(0.1, 0.4)), 0.8) * s.ranges[0].size, "velocity": s.speed * float(rng.uniform(0.05, 0.3))}


def _backlash(rng: Rng, s: Scale, size: float) -> Values:
    """What the motor crosses in two samples or more under the largest torque, and in less than a command lasts."""
    crossing = min(max(size * float(rng.uniform(0.15, 0.4)) * s.pace, 2.0 * s.dt), 0.8 * s.pace)
    return {"width": 0.5 * s.ranges[0].size / s.plant.parameters["mass"] * crossing**2}


@dataclass(frozen=True)
class Kind:
    """robots that may have the effect, its channel, how its values are drawn, and other names for the same thing."""

    robots: tuple[str, ...]
    channel: str
    draw: Callable[[Rng, Scale, float], Values]
    same: tuple[tuple[str, str | None], ...] = ()


KINDS = {
    "wheel_radius_scale": Kind(("differential_drive", "unicycle"), "*", _wheels, (("wheel_slip", None),)),
    "castor_drag": Kind(("castor",), "*", _castor),
    "rear_slip": Kind(("bicycle",), "*", _rear),
    "steering_ratio": Kind(("bicycle",), "steer_cmd", _ratio, (("input_gain", "steer_cmd"),)),
    "steering_offset": Kind(("bicycle",), "steer_cmd", _offset, (("input_bias", "steer_cmd"),)),
    "track_scale": Kind(("differential_drive",), "theta", _track),
    "link_gravity": Kind(("joint",), "q", _gravity),
    "torque_ripple": Kind(("joint",), "q", _ripple),
    "load_friction": Kind(("joint",), "qd", _load),
    "static_friction": Kind(("joint",), "qd", _static, (("stribeck_friction", "qd"),)),
    "gear_backlash": Kind(("joint",), "force", _backlash),
}

FAR = (0.6, 6.0)
"""Of a joint, speed times pace, rad: it turns far enough for the sine of its angle to show."""


def robot(rng: Rng, name: str) -> Scale:
    """A robot of this name. A castor stands half a track to a track behind the axle; its model is a file."""
    while True:
        s = draw_scale(rng, ("differential_drive" if name == "castor" else name,), n=int(log_uniform(rng, 400, 1500)))
        if name != "joint" or FAR[0] <= s.speed * s.pace <= FAR[1]:
            break
    if name != "castor":
        return s
    arm = round(float(rng.uniform(0.4, 1.0)) * s.plant.parameters["track"], 3)
    return replace(s, plant=replace(s.plant, file=CASTOR, parameters={**s.plant.parameters, "castor": arm}))


def newer(name: str, seed: int, rng: Rng) -> TraceSet:
    """One effect at random, each alike often; in a quarter of the sets nothing is missing."""
    effect = str(rng.choice(list(KINDS)))
    kind = KINDS[effect]
    which = str(rng.choice(kind.robots))

    def draw(number: int, rng: Rng, size: float, loud: float, *, missing: bool = True) -> Draft:
        s = robot(rng, which)
        one = (Missing(effect, kind.channel, kind.draw(rng, s, size)),) if missing else ()
        rule: dict[str, Any] = {"declared": (EXACT,)} if s.plant.pose and not s.plant.file else {}
        law = str(rng.choice(["white", "white", "white", "coloured", "quantised"]))
        return Draft(s, draw_noise(rng, s, law, loud=loud), draw_law(rng, closed=0.25 if s.plant.pose else 0.5), "grid", one, **rule)

    if rng.random() < CLEAN_SHARE:
        draft = draw(0, rng, 1.0, 0.3, missing=False)
        recording, errors = realise(rng, draft)
        return TraceSet(name, seed, recording, draft.model(), {"expect": "clean", **common(draft, errors), "kind": which}, draft=draft)
    draft, recording, errors = sized(rng, draw, LARGE, robots=8)
    accepted = [[[effect, kind.channel if kind.channel != "*" else None], *map(list, kind.same)]]
    truth = {"expect": "one", **common(draft, errors), "accepted": accepted, "close": True}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)
