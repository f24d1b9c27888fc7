"""Two effects that hide each other may have a third one beside them, without which they leave something."""

from __future__ import annotations

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

pytestmark = pytest.mark.slow

MOTOR = """import numpy as np

STATES, INPUTS, PARAMS = ("speed",), ("volts",), {"gain": 28.0, "tau": 0.2}


def step(x, u, dt, p):
    settled = p["gain"] * u
    return settled + (x - settled) * np.exp(-dt / p["tau"])
"""
LEVELS = [(5.0, 315), (2.0, 129), (2.5, 185), (8.0, 58), (7.0, 111), (7.6, 83), (6.3, 152), (5.2, 48)]
DEAD = {"input_bias", "input_deadband", "coulomb_friction", "sensor_offset"}
"""What a dead zone is called, of a motor that turns one way only."""


@pytest.mark.parametrize("gain", [28.0, *first(0, [25.0, 30.0])])
@pytest.mark.parametrize("seed", first(1, range(1, 5)))
def test_a_motor_whose_gain_and_dead_zone_and_time_constant_are_off(tmp_path, seed, gain):
    """A larger gain and a dead zone leave the mean speed where it was: neither shows alone, and both leave what the time constant does."""
    (tmp_path / "motor.py").write_text(MOTOR)
    model = compose(ModelSpec(str(tmp_path / "motor.py"), 0.02, {"gain": gain}))
    rng = np.random.default_rng(seed)
    u = np.concatenate([np.full(rows, volts) for volts, rows in LEVELS])
    x, rows, stays = 130.0, [], np.exp(-0.02 / 0.18)
    for volts in u:
        rows.append(x)
        settled = 32.2 * volts - 28.6
        x = settled + (x - settled) * stays
    y = np.array(rows) + 3.2 * rng.normal(size=len(u))
    found = trace(from_arrays(model, [(y[:, None], u[:-1, None])]), model)
    assert found.verdict == "ambiguous"
    named = {e.name: e for e in found.effects}
    assert {"input_gain", "parameter_change"} <= {*named}
    assert len({*named} & DEAD) == 1
    assert named["input_gain"].values["gain"] == pytest.approx(32.2 / gain, rel=0.03)
