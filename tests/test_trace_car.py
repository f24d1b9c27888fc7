"""A car at speed: both axles slide on their tyres. What the kinematic model lacks has its textbook numbers, and no false one."""

import numpy as np
import pytest
from seeds import first
from trace_robots import commands

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

MASS_KG, INERTIA, FRONT_M, REAR_M, FRONT_N, REAR_N = 1500.0, 2500.0, 1.2, 1.5, 80_000.0, 90_000.0
DT_S, PARTS, STEPS, BASE_M = 0.1, 20, 1200, 2.7
UNDERSTEER = MASS_KG * (REAR_M * REAR_N - FRONT_M * FRONT_N) / (BASE_M * FRONT_N * REAR_N)
GIVES_WAY = MASS_KG * FRONT_M / (BASE_M * REAR_N)


def _driven(seed):
    """A driver at 6 to 25 m/s; what GPS and two antennas see of the rear axle.

    Linear tyres (R. Rajamani, Vehicle dynamics and control, 2.3).
    """
    rng = np.random.default_rng(seed)
    asked = commands(rng, 1, STEPS, DT_S, [(-0.06, 0.06), (6.0, 25.0)], hold=(1.5, 6.0), rest=0.0)[0]
    u = np.empty_like(asked)
    u[0] = 0.0, asked[0, 1]
    for k in range(1, STEPS):
        u[k] = u[k - 1] + DT_S * (asked[k] - u[k - 1]) / [0.3, 1.0]
    x = y = heading = across = turning = 0.0
    rows, h = [[0.0, 0.0, 0.0, u[0, 1]]], DT_S / PARTS
    for steer, v in u:
        for _ in range(PARTS):
            front = FRONT_N * (steer - (across + FRONT_M * turning) / v)
            rear = -REAR_N * (across - REAR_M * turning) / v
            across += h * ((front + rear) / MASS_KG - v * turning)
            turning += h * (FRONT_M * front - REAR_M * rear) / INERTIA
            slides = across - REAR_M * turning
            middle = heading + 0.5 * h * turning
            x += h * (v * np.cos(middle) - slides * np.sin(middle))
            y += h * (v * np.sin(middle) + slides * np.cos(middle))
            heading += h * turning
        rows.append([x, y, heading, v])
    return np.array(rows) + rng.normal(size=(STEPS + 1, 4)) * [0.015, 0.015, 0.003, 0.03], u


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, [1, 2]))
def test_a_car_on_its_tyres_understeers_and_its_rear_gives_way(seed):
    model = compose(ModelSpec("bicycle", DT_S, {"wheel_base": BASE_M}))
    result = trace(from_arrays(model, [_driven(seed)]), model)
    found = {e.name: e.parameters for e in result.effects}
    assert result.verdict in {"traced", "ambiguous"}
    assert {"understeer", "rear_slip"} <= set(found) <= {"understeer", "rear_slip", "integration_scheme", "input_lag", "input_delay"}
    assert found["understeer"]["coefficient"][0] == pytest.approx(UNDERSTEER, rel=0.05)
    assert found["rear_slip"]["coefficient"][0] == pytest.approx(GIVES_WAY, rel=0.08)
