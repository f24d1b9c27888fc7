"""Columns that are not what they say are told under a model, too, that lacks so much that it foretells little as they should be."""

import numpy as np
import pytest
from trace_robots import GEOMETRY, commands

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.checks.columns import WELL, check_plausible
from s2r_runtime.trace.checks.prediction_error import unforetold
from s2r_runtime.trace.checks.scale_free_error import loosely_unforetold, sizes
from s2r_runtime.trace.data.dataset import Stream, from_streams

DT, STEPS = 0.05, 900
ROBOTS = {  # what each truly is, and its commands
    "differential_drive": (
        [
            ("track_scale", "theta", {"gain": 0.35}),
            ("input_lag", "cmd_left", {"time_constant": 0.6}),
            ("lateral_slip", "*", {"coefficient": 0.1}),
        ],
        [(-3.0, 8.0)] * 2,
    ),
    "bicycle": (
        [("input_lag", "speed_cmd", {"time_constant": 0.9}), ("input_delay", "steer_cmd", {"delay": 0.1})],
        [(-0.4, 0.4), (0.2, 2.0)],
    ),
    "joint": (
        [("coulomb_friction", "qd", {"force": 0.9}), ("viscous_friction", "qd", {"coefficient": 1.5})],
        [(-3.0, 3.0)],
    ),
}


def _recorded(name, seed=1):
    effects, bounds = ROBOTS[name]
    model, robot = (compose(ModelSpec(name, DT, GEOMETRY.get(name, {}), tuple(EffectSpec(*e) for e in some))) for some in ((), effects))
    rng = np.random.default_rng(seed)
    u = commands(rng, 1, STEPS, DT, bounds)[0]
    x, hidden, rows = np.zeros((1, len(model.states))), robot.at_rest(1), []
    for k in range(STEPS):
        rows.append(x[0])
        x, hidden = robot.step(x, u[k : k + 1], hidden)
    return model, np.array(rows) + 1e-3 * rng.normal(size=(STEPS, len(model.states))), u


def _data(model, y, u):
    t = DT * np.arange(STEPS)
    return from_streams(model, [(Stream(t, y), Stream(t, u))], "here.csv")


DEGREES = 180.0 / np.pi
MISTAKES = {
    "a skidding robot in degrees": ("differential_drive", lambda y, u: (y * [1, 1, DEGREES, 1, 1], u), "theta seems to be in degrees"),
    "its x and y": ("differential_drive", lambda y, u: (y[:, [1, 0, 2, 3, 4]], u), "the columns x and y seem to be exchanged"),
    "its millimetres": ("differential_drive", lambda y, u: (y * [1000, 1000, 1, 1, 1], u), "x and y seem to be in mm"),
    "a slow car in degrees": ("bicycle", lambda y, u: (y * [1, 1, DEGREES, 1], u), "theta seems to be in degrees"),
    "its steering": ("bicycle", lambda y, u: (y, u * [-1, 1]), "steer_cmd seems to have the other sign"),
    "its commands": ("bicycle", lambda y, u: (y, u[:, ::-1]), "the columns steer_cmd and speed_cmd seem to be exchanged"),
    "a stiff drive in degrees": ("joint", lambda y, u: (y * DEGREES, u), "q and qd seem to be 57.3 times"),
    "its force": ("joint", lambda y, u: (y, -u), "force seems to have the other sign"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", MISTAKES)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_mistake_is_told_although_the_model_is_a_poor_one(case, seed):
    name, spoil, said = MISTAKES[case]
    model, y, u = _recorded(name, seed)
    with pytest.raises(RecordingError, match=said) as told:
        check_plausible(model, _data(model, *spoil(y, u)))
    assert len(str(told.value).splitlines()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_a_poor_model_is_no_mistake(name):
    """It foretells little as it is, and nearly all if states may be off in size: nothing is wrong with the columns."""
    for seed in range(1, 5):
        model, y, u = _recorded(name, seed)
        data = _data(model, y, u)
        assert np.max(unforetold(model, data)) > WELL
        assert np.nanmin(loosely_unforetold(model, data)) < WELL
        check_plausible(model, data)


OTHERWISE = {  # what a mistake of the columns would look like
    "a compass that is off by a quarter turn": ([("heading_offset", "theta", {"angle": 1.57})], (0.1, 0.5)),
    "the other way": ([("heading_offset", "theta", {"angle": -1.57}), ("input_lag", "w", {"time_constant": 0.5})], (0.1, 0.5)),
    "in the wind": ([("heading_offset", "theta", {"angle": 1.57}), ("constant_disturbance", "world", {"x": 0.1, "y": 0.1})], (0.1, 0.5)),
    "a motor that hardly turns": ([("input_saturation", "v", {"low": -0.02, "high": 0.02})], (0.1, 0.5)),
    "many turns in so long a time": ([("input_lag", "v", {"time_constant": 0.9})], (0.1, 0.5)),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", OTHERWISE)
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_what_looks_like_exchanged_columns_and_is_an_effect_is_not_refused(case, seed):
    effects, speeds = OTHERWISE[case]
    turns = (-14.0, 14.0) if case.startswith("many") else (-1.0, 1.0)
    model, robot = (compose(ModelSpec("unicycle", DT, {}, tuple(EffectSpec(*e) for e in some))) for some in ((), effects))
    rng = np.random.default_rng(seed)
    u = commands(rng, 1, STEPS, DT, [speeds, turns])[0]
    x, hidden, rows = np.array([[0.0, 0.0, rng.uniform(-3.0, 3.0)]]), robot.at_rest(1), []
    for k in range(STEPS):
        rows.append(x[0])
        x, hidden = robot.step(x, u[k : k + 1], hidden)
    check_plausible(model, _data(model, np.array(rows) + 1e-3 * rng.normal(size=(STEPS, 3)), u))


@pytest.mark.parametrize(("drive", "steer"), [(0.12, 1.0), (0.12, 0.5), (0.3, 0.2), (0.12, 0.3)])
def test_weak_motors_are_in_no_other_unit(drive, steer):
    """A car's measured speed says how far it goes: it is what it says, however little of its command that is. Two weak gains together make
    it turn by nearly as little as degrees do.
    """
    model = compose(ModelSpec("bicycle", DT, GEOMETRY["bicycle"]))
    gains = tuple(EffectSpec("input_gain", *e) for e in (("speed_cmd", {"gain": drive}), ("steer_cmd", {"gain": steer})))
    robot = compose(ModelSpec("bicycle", DT, GEOMETRY["bicycle"], gains))
    rng = np.random.default_rng(1)
    u = commands(rng, 1, STEPS, DT, [(-0.4, 0.4), (0.2, 2.0)])[0]
    x, hidden, rows = np.zeros((1, 4)), robot.at_rest(1), []
    for k in range(STEPS):
        rows.append(x[0])
        x, hidden = robot.step(x, u[k : k + 1], hidden)
    check_plausible(model, _data(model, np.array(rows) + 1e-3 * rng.normal(size=(STEPS, 4)), u))


@pytest.mark.parametrize("gain", [-1.0, 0.25, 0.6, 1.6])
def test_how_far_a_state_goes_of_what_was_foretold_is_told_beside_friction(gain):
    model, y, u = _recorded("joint")
    found = sizes(model, _data(model, y, gain * u))
    assert found[1] == pytest.approx(1.0 / gain, rel=0.1)
