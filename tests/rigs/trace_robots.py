"""Robots of the tests' own: many at once, ten parts a step, with the physics of effects written without the library.

Where the library averages over steps and filters exactly, these step through time in small parts; where it says what an
effect is, these do it again in their own words. So a test that finds the effect does not test the library against itself.
"""

import math

import numpy as np

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays

PARTS = 10
INPUTS = {
    "unicycle": ("v", "w"),
    "differential_drive": ("cmd_left", "cmd_right"),
    "bicycle": ("steer_cmd", "speed_cmd"),
    "double_integrator": ("ax", "ay"),
    "joint": ("force",),
}
WIDTH = {"unicycle": 3, "differential_drive": 5, "bicycle": 4, "double_integrator": 4, "joint": 2}
GEOMETRY = {"differential_drive": {"wheel_radius": 0.1, "track": 0.5}, "bicycle": {"wheel_base": 0.33}, "joint": {"mass": 2.0}}
POSES = ("unicycle", "differential_drive", "bicycle")
ROBOTARIUM = (("input_delay", "*", {"delay": 0.033}), ("wheel_saturation", "*", {"speed": 0.2, "track": 0.105}))

DT, NOISE = 0.033, np.array([0.0005, 0.0005, 0.002])
BOUNDS = [(-0.2, 0.2), (-math.pi, math.pi)]


def declared(dt=DT):
    """The built-in robot's model, as its data sheet has it."""
    effects = (*ROBOTARIUM, ("integration_scheme", "*", {"scheme": "exact"}))
    return compose(ModelSpec("unicycle", dt, {}, tuple(EffectSpec(*e) for e in effects)))


def recordings(effects, sets, *, steps, seed, before=(), outside=None, inputs=None, noise=NOISE):
    """Datasets of the built-in robot with undeclared effects behind (or before) what is declared."""
    rng = np.random.default_rng(seed)
    u = (inputs or commands)(rng, sets, steps, DT, BOUNDS)
    y = drive(rng, "unicycle", u, (*before, *ROBOTARIUM, *effects), DT, noise, outside)
    return [from_arrays(declared(), [run]) for run in zip(y, u, strict=True)]


def commands(rng, robots, steps, dt, bounds, hold=(0.5, 1.6), rest=0.15):
    """(robots, steps, nu): held for a random time at random values, now and then at zero."""
    u = np.zeros((robots, steps, len(bounds)))
    for robot in u:
        k = 0
        while k < steps:
            length = max(1, int(rng.uniform(*hold) / dt))
            if rng.random() > rest:
                robot[k : k + length] = [rng.uniform(low, high) for low, high in bounds]
            k += length
    return u


def wandering(rng, robots, steps, dt, bounds):
    """(robots, steps, nu): sums of sines, never held."""
    t = dt * np.arange(steps)
    u = np.zeros((robots, steps, len(bounds)))
    for j, (low, high) in enumerate(bounds):
        phase, rate = rng.uniform(0.0, 6.3, (2, robots, 1)), rng.uniform(0.4, 2.5, (2, robots, 1))
        u[:, :, j] = 0.5 * (low + high) + 0.25 * (high - low) * (np.sin(rate[0] * t + phase[0]) + np.sin(rate[1] * t + phase[1]))
    return u


def _late(x, delay, part):
    n = round(delay / part)
    return x if n == 0 else np.concatenate([np.zeros_like(x[:, :n]), x[:, :-n]], axis=1)


def _lagged(x, time_constant, part):
    y, s, keep = np.empty_like(x), np.zeros_like(x[:, 0]), np.exp(-part / time_constant)
    for i in range(x.shape[1]):
        s_next = x[:, i] + (s - x[:, i]) * keep
        y[:, i], s = 0.5 * (s + s_next), s_next
    return y


def _uneven(x, out, back, part):
    """Follows faster away from zero than back to it."""
    y, s = np.empty_like(x), np.zeros_like(x[:, 0])
    for i in range(x.shape[1]):
        s_next = x[:, i] + (s - x[:, i]) * np.exp(-part / np.where(np.abs(x[:, i]) > np.abs(s), out, back))
        y[:, i], s = 0.5 * (s + s_next), s_next
    return y


def _ringing(x, rate, damping, part):
    y, s, v = np.empty_like(x), np.zeros_like(x[:, 0]), np.zeros_like(x[:, 0])
    for i in range(x.shape[1]):
        v = v + part * (rate**2 * (x[:, i] - s) - 2.0 * damping * rate * v)
        s_next = s + part * v
        y[:, i], s = 0.5 * (s + s_next), s_next
    return y


def _warming(x, loss, time_constant, part):
    """Gives less the more was asked lately."""
    y, z = np.empty_like(x), np.zeros_like(x[:, 0])
    for i in range(x.shape[1]):
        z = z + part / time_constant * ((x[:, i] / np.pi) ** 2 - z)
        y[:, i] = x[:, i] / (1.0 + loss * z)
    return y


def _wheels(u, speed, track):
    left = np.clip(u[..., 0] - u[..., 1] * track / 2, -speed, speed)
    right = np.clip(u[..., 0] + u[..., 1] * track / 2, -speed, speed)
    return np.stack([(left + right) / 2, (right - left) / track], axis=-1)


_ACTS = {
    "input_gain": lambda x, p, part: p["gain"] * x,
    "input_bias": lambda x, p, part: x + p["bias"],
    "input_delay": lambda x, p, part: _late(x, p["delay"], part),
    "input_lag": lambda x, p, part: _lagged(x, p["time_constant"], part),
    "input_saturation": lambda x, p, part: np.clip(x, p["low"], p["high"]),
    "deadband": lambda x, p, part: np.sign(x) * np.maximum(np.abs(x) - p["width"], 0.0),
    "uneven_lag": lambda x, p, part: _uneven(x, p["out"], p["back"], part),
    "ringing": lambda x, p, part: _ringing(x, p["rate"], p["damping"], part),
    "warming": lambda x, p, part: _warming(x, p["loss"], p["time_constant"], part),
    "cubic": lambda x, p, part: x + p["share"] * x * ((x / np.pi) ** 2 - 0.6),
    "wavy": lambda x, p, part: x + p["height"] * np.sin(3.0 * x),
}


def acted(u, effects, names, part):
    """u (robots, parts, nu) through (name, channel, parameters) in order."""
    u = u.copy()
    for name, channel, p in effects:
        if name == "wheel_saturation":
            u = _wheels(u, p["speed"], p["track"])
            continue
        for c in range(len(names)) if channel == "*" else [names.index(channel)]:
            u[..., c] = _ACTS[name](u[..., c], p, part)
    return u


def drive(rng, name, u, effects, dt, noise, outside=None):
    """u (robots, steps, nu) -> measured states (robots, steps + 1, nx), angles wrapped.

    outside(x, first, second) -> first, second, dx, dy for poses (speed, yaw rate, speeds along the world's axes): physics that no effect
    of the library has.
    """
    if outside is not None and name not in POSES:
        raise ValueError(f"{name}: has no pose that something outside could move")
    robots, steps, _ = u.shape
    part = dt / PARTS
    a = acted(np.repeat(u, PARTS, axis=1), effects, INPUTS[name], part)
    x = np.zeros((robots, WIDTH[name]))
    if name in POSES:
        x[:, :2], x[:, 2] = rng.uniform(-1.0, 1.0, (robots, 2)), rng.uniform(-3.0, 3.0, robots)
    if outside is None:
        states = _driven(name, x, a, part)[:, ::PARTS]
    else:
        states = np.empty((robots, steps + 1, WIDTH[name]))
        states[:, 0] = x
        for i in range(steps * PARTS):
            _move_pose(name, x, a[:, i], part, outside)
            if (i + 1) % PARTS == 0:
                states[:, (i + 1) // PARTS] = x
    y = states + rng.normal(size=states.shape) * noise
    if name in POSES:
        y[..., 2] = (y[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return y


def _driven(name, x, a, part):
    """x (robots, nx) at rest, (robots, parts, nu) what acts -> (robots, parts + 1, nx): all parts at once, where nothing depends on where
    a robot is.
    """

    def summed(rate):
        return np.concatenate([np.zeros_like(rate[:, :1]), np.cumsum(part * rate, axis=1)], axis=1)

    if name not in POSES:
        acceleration = a / GEOMETRY.get(name, {}).get("mass", 1.0)
        speed = summed(acceleration)
        return np.concatenate([summed(speed[:, :-1] + part / 2 * acceleration), speed], axis=2)
    v, w, wheels = _speeds(name, a)
    theta = x[:, 2:3] + summed(w)
    middle = theta[:, :-1] + w * part / 2
    pose = np.stack([x[:, :1] + summed(v * np.cos(middle)), x[:, 1:2] + summed(v * np.sin(middle)), theta], axis=2)
    return np.concatenate([pose, np.concatenate([x[:, None, 3:], wheels], axis=1)], axis=2)


def _speeds(name, c):
    """Speed, yaw rate, and the further states (..., k), of what acts (..., nu)."""
    if name == "unicycle":
        return c[..., 0], c[..., 1], c[..., :0]
    if name == "differential_drive":
        return 0.1 * (c[..., 0] + c[..., 1]) / 2, 0.1 * (c[..., 1] - c[..., 0]) / 0.5, c
    return c[..., 1], c[..., 1] * np.tan(c[..., 0]) / 0.33, c[..., 1:]


def _move_pose(name, x, c, part, outside):
    v, w, x[:, 3:] = _speeds(name, c)
    v, w, dx, dy = outside(x, v, w)
    middle = x[:, 2] + w * part / 2
    x[:, 0] += part * (v * np.cos(middle) + dx)
    x[:, 1] += part * (v * np.sin(middle) + dy)
    x[:, 2] += part * w
