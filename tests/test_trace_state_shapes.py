"""Names are held against shapes of a state, too: a drag with a power of its own, a tank that overflows."""

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, insert, problem
from s2r_runtime.trace.hypotheses.state_nonlinearity import STATE_SHAPES, starts
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection import ties

pytestmark = pytest.mark.slow

DT = 0.02
JOINT = compose(ModelSpec("joint", DT, {"mass": 0.8}))
POWER, ABOVE, BELOW = STATE_SHAPES

TANK = """
import numpy as np
STATES = ("level",)
INPUTS = ("pump",)
PARAMS = {"lift": 0.25, "outflow": 0.18}

def step(x, u, dt, params):
    level = x[:, 0]
    for _ in range(8):
        level = level + dt / 8 * (params["lift"] * u[:, 0] - params["outflow"] * np.sqrt(np.maximum(level, 0.0)))
    return np.maximum(level, 0.0)[:, None]
"""


def _driven(brake, seed, rows=900, noise=0.004):
    """A mass of 0.8 kg under forces that are held, in parts of a twentieth of a step. brake: acceleration that opposes a speed."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-4.0, 4.0, rows // 15), 15)
    x, v, seen = 0.0, 0.0, [(0.0, 0.0)]
    for force in u:
        for _ in range(20):
            v += DT / 20 * (force / 0.8 - brake(v))
            x += DT / 20 * v
        seen.append((x, v))
    return np.array(seen) + noise * rng.normal(size=(len(seen), 2)), u[:, None]


def _traced(brake, seed):
    return trace(from_arrays(JOINT, [_driven(brake, seed)]), JOINT)


@pytest.mark.parametrize(("power", "effect"), [(1.0, "viscous_friction"), (2.0, "quadratic_drag")])
def test_a_power_of_one_or_two_is_the_drag_that_has_that_name(power, effect):
    x = np.random.default_rng(0).uniform(-2.0, 2.0, (50, 2))
    u = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 1))
    named = compose(ModelSpec("joint", DT, {"mass": 0.8}, (EffectSpec(effect, "qd", {"coefficient": 0.5}),)))
    p = {"loss": 0.5 / 0.8 * 2.0 ** (power - 1.0), "power": power, "most": 2.0}
    own = insert(JOINT, AppliedEffect(POWER, "qd", p), 0)
    assert np.allclose(own.advance(x, u, u), named.advance(x, u, u), rtol=1e-9, atol=1e-12)


def test_a_limit_cuts_what_goes_beyond_it_and_nothing_else():
    x = np.linspace(-3.0, 3.0, 13)[:, None] * [1.0, 1.0]
    for shape, at, want in ((ABOVE, 0.5, np.minimum(x[:, 1], 1.0)), (BELOW, -0.5, np.maximum(x[:, 1], -1.0))):
        after = shape.after_step(x, x[:, :1], x, JOINT.nominal, "qd", DT, {"at": at, "most": 2.0})
        assert np.array_equal(after[:, 1], want)
        assert np.array_equal(after[:, 0], x[:, 0])
    assert ABOVE.channels(compose(ModelSpec("unicycle", DT)).nominal) == ()
    assert ABOVE.channels(JOINT.nominal) == ("qd",)
    assert starts(ABOVE, np.zeros(4)) == []
    assert starts(ABOVE, np.full(4, np.nan)) == []


@pytest.mark.parametrize("seed", first(1, range(4)))
def test_a_drag_with_the_fifth_power_of_the_speed_is_no_drag_with_the_square(seed):
    result = _traced(lambda v: 0.5 * v**5, seed)
    assert result.verdict == "unexplained"
    assert "speed" in result.depends_on


@pytest.mark.parametrize("seed", first(1, range(4)))
@pytest.mark.parametrize(
    ("brake", "names"),
    [
        (lambda v: 0.6 * v * abs(v), {"quadratic_drag"}),
        (lambda v: 0.6 * v, {"viscous_friction"}),
        (lambda v: 0.4 * v + 0.4 * v * abs(v), {"viscous_friction", "quadratic_drag"}),
    ],
    ids=["square", "viscous", "both"],
)
def test_a_drag_that_has_a_name_keeps_it(brake, names, seed):
    result = _traced(brake, seed)
    assert {e.name for e in result.effects} == names


@pytest.fixture
def tank(tmp_path):
    path = tmp_path / "tank.py"
    path.write_text(TANK)
    return compose(ModelSpec(str(path), 4.0))


def _filled(seed, overflows=np.inf, pump_at_most=np.inf):
    """A tank into which a pump lifts 0.25 a second for each unit, from which 0.18 times the root of the level flows."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.8, 2.6, 120), 6)
    level, seen = 4.0, [4.0]
    for asked in u:
        for _ in range(40):
            level = min(level + 0.1 * (0.25 * min(asked, pump_at_most) - 0.18 * np.sqrt(level)), overflows)
        seen.append(level)
    return np.array(seen)[:, None] + 0.03 * rng.normal(size=(len(seen), 1)), u[:, None]


@pytest.mark.parametrize("seed", range(3))
def test_a_tank_that_overflows_is_no_pump_that_saturates(tank, seed):
    result = trace(from_arrays(tank, [_filled(seed, overflows=7.0)]), tank)
    assert result.verdict == "unexplained"
    assert "level" in result.depends_on


@pytest.mark.parametrize("seed", range(3))
def test_a_pump_that_saturates_keeps_its_name(tank, seed):
    result = trace(from_arrays(tank, [_filled(seed, pump_at_most=2.0)]), tank)
    assert [(e.name, e.channel) for e in result.effects] == [("input_saturation", "pump")]
    assert abs(result.effects[0].parameters["high"][0] - 2.0) < 0.05


def test_what_does_nothing_on_rich_inputs_says_nothing_there_of_the_others():
    """A limit just below what was asked most does nothing where less is asked: no explanation is nearest to all others by that."""
    rng = np.random.default_rng(0)
    model = compose(ModelSpec("unicycle", DT))
    u = np.repeat(rng.uniform(0.0, 1.0, (40, 2)), 10, axis=0)
    data = from_arrays(model, [(rng.normal(size=(401, 3)), u)])
    given = problem(data, steps_of(data))
    effects = [("input_gain", {"gain": 0.9}), ("input_bias", {"bias": -0.05}), ("input_saturation", {"low": -9.0, "high": 9.0})]
    models = [compose(ModelSpec("unicycle", DT, {}, (EffectSpec(name, "v", p),))) for name, p in effects]
    gain, bias, limit = ties._rich(given, model).worst(models, evaluate(given, model).model)
    assert limit == pytest.approx(1.0)
    assert gain < 1.0
    assert bias < 1.0
