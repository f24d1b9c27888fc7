"""Recordings on which effects cannot be told apart, by how the robot was driven: the honest answer names several.

same_speed    v (or speed_cmd) never changes: gain, bias and drag of it are one number; on a bicycle, understeer and track scale
two_values    an input takes two values only: gain, saturation, deadband and drag of it are one number
one_heading   it drives straight ahead all the time: wind, slope and bias push alike; a heading offset is a sideways drift
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trace_sets.excitation import LAWS
from trace_sets.making import EXACT, Draft, Missing, common, draw_noise, realise
from trace_sets.recording import TraceSet
from trace_sets.scale import Scale, draw_scale

Array = NDArray[np.float64]
Rng = np.random.Generator

RATIO = 1.5
TRIES = 12

Drawn = tuple[Scale, Missing, list[list[str | None]], Callable[[Rng, Array], Array]]


def confounded(name: str, seed: int, rng: Rng) -> TraceSet:
    """One of the three, with an effect that matters."""
    kind = str(rng.choice(["same_speed", "two_values", "one_heading"]))
    size = 1.0
    for _ in range(TRIES):
        s, missing, rivals, asked = {"same_speed": same_speed, "two_values": two_values, "one_heading": one_heading}[kind](rng, size)
        rule: dict[str, Any] = {"declared": (EXACT,)} if s.plant.pose else {}
        draft = Draft(
            s, draw_noise(rng, s, "white", 10 ** rng.uniform(-3.5, -2.3)), kind, "grid", (missing,), asked=asked, whole=True, **rule
        )
        recording, errors = realise(rng, draft)
        if errors and errors.ratio >= RATIO:
            break
        size *= 1.5
    truth = {"expect": "tie", **common(draft, errors), "kind": kind, "accepted": [rivals]}
    return TraceSet(name, seed, recording, draft.model(), truth, draft=draft)


def _columns(s: Scale, laws: list[Callable[[Rng, Array], Array]]) -> Callable[[Rng, Array], Array]:
    return lambda rng, t: np.column_stack([law(rng, t) for law in laws])


def _rich(s: Scale, j: int) -> Callable[[Rng, Array], Array]:
    return lambda rng, t: s.ranges[j].scaled(LAWS["holds"](rng, t, s.pace))


def _constant(value: float) -> Callable[[Rng, Array], Array]:
    return lambda rng, t: np.full(len(t), value)


def _scale(rng: Rng, names: tuple[str, ...]) -> Scale:
    rate = float(rng.choice([10.0, 20.0, 30.303, 50.0]))
    return draw_scale(rng, names, n=int(rng.uniform(400, 1500)), rate=rate)


def same_speed(rng: Rng, size: float) -> Drawn:
    """Speed never changes, the other input does."""
    s = _scale(rng, ("unicycle", "bicycle"))
    share = float(rng.uniform(0.05, 0.25)) * size
    if s.plant.name == "unicycle":
        v = float(rng.uniform(0.4, 1.0)) * s.speed
        which = str(rng.choice(["input_gain", "input_bias", "quadratic_drag"]))
        p = {
            "input_gain": {"gain": 1.0 - share},
            "input_bias": {"bias": -share * v},
            "quadratic_drag": {"coefficient": min(share, 0.45) / v},
        }[which]
        rivals: list[list[str | None]] = [[n, "v"] for n in ("input_gain", "input_bias", "quadratic_drag")]
        rivals += [["longitudinal_slip", None], ["constant_disturbance", "body"], ["input_saturation", "v"], ["input_deadband", "v"]]
        return s, Missing(which, "v", p), rivals, _columns(s, [_constant(v), _rich(s, 1)])
    v = float(rng.uniform(0.4, 1.0)) * s.speed
    if rng.random() < 0.5:
        missing = Missing("track_scale", "theta", {"gain": 1.0 - min(share, 0.6)})
    else:
        missing = Missing("understeer", "theta", {"coefficient": share * s.plant.parameters["wheel_base"] / v**2})
    rivals = [["track_scale", None], ["understeer", None], ["input_gain", "steer_cmd"], ["steering_ratio", "steer_cmd"]]
    return s, missing, rivals, _columns(s, [_rich(s, 0), _constant(v)])


def two_values(rng: Rng, size: float) -> Drawn:
    """An input switches between two values."""
    s = _scale(rng, ("unicycle", "double_integrator", "joint"))
    j = 1 if s.plant.name == "unicycle" else int(rng.integers(len(s.plant.inputs)))
    channel, most = s.plant.inputs[j], s.ranges[j].size
    share = min(float(rng.uniform(0.08, 0.3)) * size, 0.8)
    which = str(rng.choice(["input_gain", "input_saturation", "input_deadband"]))
    p = {
        "input_gain": {"gain": 1.0 - share},
        "input_saturation": {"low": -(1.0 - share) * most, "high": (1.0 - share) * most},
        "input_deadband": {"width": share * most},
    }[which]

    def switched(rng: Rng, t: Array) -> Array:
        period = max(0.5 * s.pace, 4.0 * s.dt)
        begin = np.cumsum(period * np.exp(rng.uniform(-0.7, 0.7, int(t[-1] / period * 3.0) + 10)))
        phase = np.searchsorted(begin, t)
        if s.plant.pose:
            return np.asarray(most * (1.0 - 2.0 * (phase % 2)))
        lengths = np.diff(begin, prepend=0.0)  # as long one way as the other, pair by pair
        begin = np.cumsum(np.repeat(lengths, 2)) - lengths[0]
        return np.asarray(most * (1.0 - 2.0 * (np.searchsorted(begin, t) % 2)))

    laws = [switched if k == j else _rich(s, k) if s.plant.pose else switched for k in range(len(s.plant.inputs))]
    rivals: list[list[str | None]] = [[n, channel] for n in ("input_gain", "input_saturation", "input_deadband", "quadratic_drag")]
    rivals += [["track_scale", None]] if s.plant.pose else [["mass_change", None]]
    return s, Missing(which, channel, p), rivals, _columns(s, laws)


def one_heading(rng: Rng, size: float) -> Drawn:
    """Straight ahead, at changing speed or not."""
    s = _scale(rng, ("unicycle",))
    share = float(rng.uniform(0.05, 0.2)) * size * s.speed
    if rng.random() < 0.5:
        which, channel = [("input_bias", "v"), ("constant_disturbance", "body")][int(rng.integers(2))]
        p: dict[str, Any] = {"bias": share} if which == "input_bias" else {"x": share, "y": 0.0}
        rivals: list[list[str | None]] = [["input_bias", "v"], ["constant_disturbance", "body"], ["constant_disturbance", "world"]]
        return s, Missing(which, channel, p), [*rivals, ["gravity_slope", None]], _columns(s, [_rich(s, 0), _constant(0.0)])
    v = float(rng.uniform(0.4, 1.0)) * s.speed
    angle = float(rng.choice([-1.0, 1.0])) * min(float(rng.uniform(0.03, 0.2)) * size, 1.0)
    if rng.random() < 0.5:
        missing = Missing("heading_offset", "theta", {"angle": angle})
    else:
        missing = Missing("constant_disturbance", "body", {"x": 0.0, "y": angle * v})
    rivals = [["heading_offset", None], ["constant_disturbance", "body"], ["constant_disturbance", "world"], ["sensor_offset", "theta"]]
    return s, missing, rivals, _columns(s, [_constant(v), _constant(0.0)])
