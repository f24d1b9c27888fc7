"""Values of the library's effects, in proportion to what a recording shows; `size` > 0 makes an effect larger or smaller.

Each entry: on which channels an effect makes sense on a plant, and how its parameters are drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trace_sets.plants import Plant
from trace_sets.scale import Scale, log_uniform

Rng = np.random.Generator
Values = dict[str, Any]


def _sign(rng: Rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _factor(rng: Rng, size: float) -> float:
    """A gain away from 1, never below a tenth."""
    off = size * float(rng.uniform(0.3, 1.0)) * _sign(rng)
    return max(1.0 + off, 0.1) if abs(off) < 0.95 else 1.0 + abs(off)


def _late(rng: Rng, s: Scale, size: float) -> float:
    """Seconds: some steps, or what actuators have; never more than the recording shows, nor what no data could tell apart."""
    steps = s.dt * log_uniform(rng, 0.4, 8.0)
    usual = log_uniform(rng, 0.02, 0.4)
    most = min(s.duration / 20.0, 0.9 * s.pace + 4.0 * s.dt, 0.8)
    return float(min(max((steps if rng.random() < 0.5 else usual) * size, 0.1 * s.dt), most))


def gain(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"gain": _factor(rng, 0.5 * size)}


def asymmetry(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    first = _factor(rng, 0.5 * size)
    second = 1.0 + rng.uniform(-0.4, 0.4) * (first - 1.0)
    return {"gain_positive": first, "gain_negative": second} if rng.random() < 0.5 else {"gain_positive": second, "gain_negative": first}


def bias(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"bias": _sign(rng) * size * rng.uniform(0.1, 0.5) * s.amplitude(channel)}


def delay(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"delay": _late(rng, s, size)}


def lag(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"time_constant": _late(rng, s, size)}


def rate_limit(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    rate = s.amplitude(channel) / max(_late(rng, s, 2.0 * size), 0.2 * s.dt)
    return {"rate": rate} if rng.random() < 0.7 else {"rate": rate, "rate_down": rate * log_uniform(rng, 0.4, 2.5)}


def saturation(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    r = s.ranges[s.plant.inputs.index(channel)]
    share = max(1.0 - size * float(rng.uniform(0.2, 0.7)), 0.15)
    if r.low >= 0.0:
        return {"low": -3.0 * r.size, "high": share * r.size}
    kind = rng.random()
    if kind < 0.6:
        return {"low": -share * r.size, "high": share * r.size}
    if kind < 0.8:
        return {"low": -share * r.size, "high": max(1.0 - size * float(rng.uniform(0.1, 0.7)), 0.15) * r.size}
    return {"low": -3.0 * r.size, "high": share * r.size} if rng.random() < 0.5 else {"low": -share * r.size, "high": 3.0 * r.size}


def wheel_saturation(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    track = 2.0 * s.speed / s.yaw * log_uniform(rng, 0.5, 2.0)
    return {"speed": max(1.0 - size * float(rng.uniform(0.3, 0.7)), 0.15) * (s.speed + 0.5 * track * s.yaw), "track": track}


def deadband(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"width": min(size * float(rng.uniform(0.1, 0.4)), 0.7) * s.amplitude(channel)}


def backlash(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"width": min(size * float(rng.uniform(0.1, 0.6)), 0.9) * s.amplitude(channel)}


def coupling(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    other = next(name for name in s.plant.inputs if name != channel)
    share = size * float(rng.uniform(0.1, 0.5))
    return {"from": other, "coefficient": _sign(rng) * share * s.amplitude(channel) / s.amplitude(other)}


def drift(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    change = size * float(rng.uniform(0.2, 0.7))
    return {"rate": (change if change > 0.9 or rng.random() < 0.5 else -change) / s.duration}


def regime(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"time": float(rng.uniform(0.2, 0.75)) * s.duration, "gain": _factor(rng, 0.6 * size)}


def periodic(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    frequency = log_uniform(rng, max(3.0 / s.duration, 0.1), max(min(0.2 / s.dt, 8.0), 6.0 / s.duration))
    amplitude = size * rng.uniform(0.1, 0.5) * s.amplitude(channel)
    return {"frequency": frequency, "amplitude": amplitude, "phase": float(rng.uniform(-3.1, 3.1))}


def drag(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    if channel in s.plant.inputs:
        return {"coefficient": min(size * float(rng.uniform(0.1, 0.45)), 0.48) / s.amplitude(channel)}
    return {"coefficient": size * rng.uniform(0.1, 0.8) * _usual_push(s) / s.speed**2}


def _usual_push(s: Scale) -> float:
    """A force (or acceleration) that is felt among the commanded ones."""
    return s.ranges[0].size


def viscous(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    c = size * rng.uniform(0.1, 0.8) * _usual_push(s) / s.speed
    if rng.random() < 0.7:
        return {"coefficient": c}
    return {"coefficient_positive": c, "coefficient_negative": c * log_uniform(rng, 0.3, 3.0)}


def coulomb(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    f = min(size * float(rng.uniform(0.05, 0.35)), 0.6) * _usual_push(s)
    if rng.random() < 0.7:
        return {"force": f}
    return {"force_positive": f, "force_negative": min(f * log_uniform(rng, 0.4, 2.5), 0.7 * _usual_push(s))}


def stribeck(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    f = min(size * float(rng.uniform(0.05, 0.25)), 0.35) * _usual_push(s)
    return {"force": f, "static_force": f * float(rng.uniform(1.6, 3.0)), "velocity": s.speed * float(rng.uniform(0.08, 0.3))}


def stiffness(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    span = 1.5 * s.speed * s.pace
    return {"coefficient": size * rng.uniform(0.2, 1.0) * _usual_push(s) / span**3}


def disturbance(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    strong = size * rng.uniform(0.05, 0.4) * (s.speed if s.plant.pose else _usual_push(s))
    if s.plant.name == "joint":
        return {"x": _sign(rng) * strong}
    angle = rng.uniform(-np.pi, np.pi)
    return {"x": float(strong * np.cos(angle)), "y": float(strong * np.sin(angle))}


def lateral(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"coefficient": _sign(rng) * size * rng.uniform(0.1, 0.5) / max(s.yaw, 0.3)}


def slip(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"ratio": min(size * float(rng.uniform(0.05, 0.4)), 0.7)}


def track(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"gain": max(1.0 - size * float(rng.uniform(0.1, 0.5)), 0.2)}


def understeer(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"coefficient": size * rng.uniform(0.1, 1.0) * s.plant.parameters["wheel_base"] / s.speed**2}


def angle(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    return {"angle": _sign(rng) * min(size * float(rng.uniform(0.05, 0.5)), 1.2)}


def sensor_offset(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    usual = s.speed / s.plant.parameters["wheel_radius"] if channel.startswith("wheel") else s.speed
    return {"offset": _sign(rng) * size * rng.uniform(0.05, 0.4) * usual}


def lever(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    r, a = size * rng.uniform(0.05, 0.5) * s.speed / max(s.yaw, 0.3), rng.uniform(-np.pi, np.pi)
    return {"x": float(r * np.cos(a)), "y": float(r * np.sin(a))}


def field(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    """Weak enough that a robot is not carried away over the whole recording."""
    m = min(size, 1.5) * 2.0 / max(s.duration, 4.0) * rng.uniform(-1.0, 1.0, (2, 2))
    return {"matrix": m.tolist()}


def mass(rng: Rng, s: Scale, channel: str, size: float) -> Values:
    ratio = _factor(rng, 0.6 * size)
    return {"ratio": ratio} if rng.random() < 0.5 else {"mass": ratio * s.plant.parameters["mass"]}


Draw = Callable[[Rng, Scale, str, float], Values]

ON_INPUTS: dict[str, Draw] = {
    "input_gain": gain,
    "input_gain_asymmetry": asymmetry,
    "input_bias": bias,
    "input_delay": delay,
    "input_lag": lag,
    "input_rate_limit": rate_limit,
    "input_saturation": saturation,
    "input_deadband": deadband,
    "input_backlash": backlash,
    "input_coupling": coupling,
    "input_gain_drift": drift,
    "regime_change": regime,
    "periodic_disturbance": periodic,
    "quadratic_drag": drag,
}

ON_POSES: dict[str, tuple[str, Draw]] = {
    "constant_disturbance": ("world|body", disturbance),
    "gravity_slope": ("*", disturbance),
    "lateral_slip": ("*", lateral),
    "longitudinal_slip": ("*", slip),
    "track_scale": ("theta", track),
    "heading_offset": ("theta", angle),
    "sensor_lever_arm": ("*", lever),
    "position_field": ("*", field),
}

ON_MASSES: dict[str, Draw] = {
    "viscous_friction": viscous,
    "coulomb_friction": coulomb,
    "stribeck_friction": stribeck,
    "quadratic_drag": drag,
}


def names(plant: Plant) -> list[str]:
    """Effects that this plant may have."""
    found = [n for n in ON_INPUTS if n != "input_coupling" or len(plant.inputs) > 1]
    found.remove("quadratic_drag")
    if plant.pose:
        found += [*ON_POSES, "integration_scheme"]
        found += ["quadratic_drag", "wheel_saturation"] if plant.name == "unicycle" else []
        found += ["quadratic_drag", "understeer", "sensor_offset"] if plant.name == "bicycle" else []
        found += ["sensor_offset"] if plant.name == "differential_drive" else []
    else:
        found += [*ON_MASSES, "cubic_stiffness", "constant_disturbance", "sensor_offset"]
        found += ["mass_change"] if plant.name == "joint" else []
    return found


def draw(rng: Rng, name: str, s: Scale, size: float) -> tuple[str, Values]:
    """(channel, parameters)."""
    plant = s.plant
    channel = _channel(rng, name, s)
    if name in ON_INPUTS and channel in (*plant.inputs, "*"):
        return channel, ON_INPUTS[name](rng, s, plant.inputs[0] if channel == "*" else channel, size)
    if plant.pose and name in ON_POSES:
        return channel, ON_POSES[name][1](rng, s, channel, size)
    others: dict[str, Draw] = {
        **ON_MASSES,
        "cubic_stiffness": stiffness,
        "constant_disturbance": disturbance,
        "sensor_offset": sensor_offset,
        "mass_change": mass,
        "understeer": understeer,
        "wheel_saturation": wheel_saturation,
        "integration_scheme": lambda *_: {"scheme": "exact"},
    }
    return channel, others[name](rng, s, channel, size)


def _channel(rng: Rng, name: str, s: Scale) -> str:
    plant = s.plant
    if name in ON_POSES and plant.pose:
        return str(rng.choice(ON_POSES[name][0].split("|")))
    if name in ON_MASSES and not plant.pose:
        return str(rng.choice([plant.states[j] for j in plant.velocity]))
    if name == "cubic_stiffness":
        return str(rng.choice(plant.states[: plant.axes]))
    if name == "constant_disturbance":
        return "world"
    if name == "sensor_offset":
        return str(rng.choice(plant.states[3:] if plant.pose else plant.states[plant.axes :]))
    if name == "understeer":
        return "theta"
    if name in {"mass_change", "wheel_saturation", "integration_scheme"}:
        return "*"
    if name in {"input_delay", "input_gain_drift", "regime_change"} and len(plant.inputs) > 1 and rng.random() < 0.25:
        return "*"
    channels = [c for c in plant.inputs if name != "input_gain_asymmetry" or s.ranges[plant.inputs.index(c)].low < 0.0]
    if name == "quadratic_drag":
        channels = ["v"] if plant.name == "unicycle" else ["speed_cmd"]
    return str(rng.choice(channels or plant.inputs))
