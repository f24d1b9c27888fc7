"""A joint of an industrial arm as it is recorded: led along a smooth path by a controller, with what its model lacks."""

import math

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.dataset import from_arrays
from s2r_runtime.trace.faults import check
from s2r_runtime.trace.whole import Whole

DT_S, PARTS, INERTIA = 0.004, 8, 0.8


def _path(seed, seconds, reach=1.0):
    """Eight sines: position, speed and acceleration at a time."""
    rng = np.random.default_rng(seed)
    k = np.arange(1, 9)
    phase, size, w = rng.uniform(0, 2 * np.pi, 8), rng.uniform(0.3, 1.0, 8) / k, 0.2 * np.pi * k

    def at(t):
        s, c = np.sin(w * t + phase), np.cos(w * t + phase)
        return size @ s, size @ (w * c), -size @ (w * w * s)

    most = max(abs(at(t)[0]) for t in np.linspace(0.0, seconds, 500))
    return lambda t: tuple(reach / most * float(e) for e in at(t))


def _led(seed, gravity=0.0, dry=0.0, viscous=0.0, seconds=8.0, noise=0.004):
    """(q, qd) as an encoder of 17 bits and a tachometer tell them, and the torque of a controller that sees these."""
    rng, path, step = np.random.default_rng(seed), _path(seed, seconds), 2 * math.pi / 2**17
    (q, v, _), rows, torques, h = path(0.0), [], [], DT_S / PARTS
    for row in range(round(seconds / DT_S) + 1):
        seen, speed = round(q / step) * step, v + noise * rng.normal()
        rows.append((seen, speed))
        ahead, rate, acceleration = path(row * DT_S)
        u = INERTIA * (acceleration + 225.0 * (ahead - seen) + 24.0 * (rate - speed))
        torques.append(u)
        for _ in range(PARTS):
            free, stop = v + h * (u - gravity * math.sin(q) - viscous * v) / INERTIA, h * dry / INERTIA
            after = 0.0 if abs(free) <= stop else free - math.copysign(stop, free)
            q, v = q + 0.5 * h * (v + after), after
    return np.array(rows), np.array(torques[:-1])[:, None]


def _joint():
    return compose(ModelSpec("joint", DT_S, {"mass": INERTIA}))


@pytest.mark.parametrize("seed", [10, 11, 12])
def test_gravity_and_friction_that_hide_each_other_are_told_by_what_both_depend_on(seed):
    model = _joint()
    data = from_arrays(model, [_led(seed, gravity=4.0, dry=0.5, viscous=1.0)])
    left = Whole(check(model, data), model, horizon=125)._of_nominal()
    assert left.matters
    assert set(left.tokens) == {"position", "speed"}
