"""What was found goes by other names on some models: they stand beside it with its numbers, and are no tie."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as replace_spec
from trace_robots import DT, NOISE, ROBOTARIUM, declared, drive, recordings

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.report.page import Page
from s2r_runtime.report.trace_section import add_trace
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.hypotheses.equivalence import other_names
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.reporting.found import Found

ARCS = (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)
UNICYCLE = compose(ModelSpec("unicycle", 0.05, {}, ARCS))
JOINT = compose(ModelSpec("joint", 0.01, {"mass": 0.3}))
PLANE = compose(ModelSpec("double_integrator", 0.05))


def _called(model, found, before=(), after=()):
    """Other names of an effect, beside others."""
    effects = (*model.spec.effects, *before, EffectSpec(found.name, found.channel, found.values), *after)
    whole = compose(replace_spec(model.spec, effects=effects))
    return other_names(whole, len(model.spec.effects) + len(before), found)


@pytest.mark.parametrize(
    ("model", "found", "called"),
    [
        (UNICYCLE, Found("input_gain", "v", {"gain": (0.8, 0.7, 0.95, "-")}), {("longitudinal_slip", "*"): {"ratio": (0.2, 0.05, 0.3)}}),
        (JOINT, Found("input_gain", "force", {"gain": (0.8, 0.5, 1.0, "-")}), {("mass_change", "*"): {"ratio": (1.25, 1.0, 2.0)}}),
        (
            UNICYCLE,
            Found("input_coupling", "v", {"from": ("w", None, None, ""), "coefficient": (-0.2, -0.3, -0.1, "")}),
            {("sensor_lever_arm", "*"): {"x": (0.0, None, None), "y": (0.2, 0.1, 0.3)}},
        ),
        (
            PLANE,
            Found("constant_disturbance", "world", {"x": (0.3, 0.2, 0.4, ""), "y": (-0.1, -0.2, 0.0, "")}),
            {("gravity_slope", "*"): {"x": (0.3, 0.2, 0.4), "y": (-0.1, -0.2, 0.0)}},
        ),
        (UNICYCLE, Found("input_lag", "v", {"time_constant": (0.3, 0.2, 0.4, "s")}), {}),
    ],
)
def test_other_names_have_the_numbers_as_they_are_called_there(model, found, called):
    told = {(e.name, e.channel): {name: value[:3] for name, value in e.parameters.items()} for e in _called(model, found)}
    assert told == {
        key: {name: tuple(v if v is None else pytest.approx(v) for v in value) for name, value in p.items()} for key, p in called.items()
    }


@pytest.mark.parametrize("end", [None, -2.0])
def test_an_end_that_is_none_by_the_other_name_is_not_told(end):
    """An interval without an end, and a gain below zero, which no mass makes."""
    (mass,) = _called(JOINT, Found("input_gain", "force", {"gain": (0.8, end, 1.0, "-")}))
    assert mass.parameters["ratio"][:3] == (pytest.approx(1.25), None, None)


def test_by_each_name_the_model_does_the_same():
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(20, 2)), rng.normal(size=(20, 1))
    found = Found("input_gain", "force", {"gain": (0.8, None, None, "-")})
    steps = []
    for e in (found, *_called(JOINT, found)):
        model = compose(ModelSpec("joint", 0.01, {"mass": 0.3}, (EffectSpec(e.name, e.channel, e.values),)))
        steps.append(model.step(x, u, model.at_rest(20))[0])
    assert len(steps) == 2
    assert np.allclose(steps[0], steps[1], rtol=1e-12)


@pytest.mark.slow
def test_a_trace_tells_them_and_stays_traced():
    found = trace(recordings([("input_gain", "w", {"gain": 0.8})], 1, steps=700, seed=3)[0], declared())
    assert (found.verdict, found.rivals, found.suggested_excitation) == ("traced", (), None)
    (other,) = found.to_json()["ambiguous_with"]
    assert (other["name"], other["channel"], other["same_thing"]) == ("track_scale", "theta", True)
    mine = found.to_json()["effects"][0]["parameters"]["gain"]
    assert [other["parameters"]["gain"][k] for k in ("value", "low", "high")] == pytest.approx([mine[k] for k in ("value", "low", "high")])
    assert "the same thing on this model: track_scale on theta: gain = 0.8" in found.text()
    page = Page("", "")
    add_trace(page, found.to_json())
    assert page.html().count("the same thing on this model") == 1


def test_a_point_beside_the_middle_is_a_speed_by_turning_where_the_robot_moves_on_arcs():
    """Only the scheme that is composed with the model says that it does."""
    arm = compose(ModelSpec("unicycle", 0.05, {}, (*ARCS, EffectSpec("sensor_lever_arm", "*", {"x": 0.0, "y": 0.2}))))
    told = _called(UNICYCLE, Found("sensor_lever_arm", "*", {"x": (0.0, None, None, "m"), "y": (0.2, 0.1, 0.3, "m")}))
    assert [(e.name, e.channel, e.values) for e in told] == [("input_coupling", "v", {"from": "w", "coefficient": pytest.approx(-0.2)})]
    other = AppliedEffect(registry().get("effects", "input_coupling"), "v", told[0].values)
    coupled = compose(ModelSpec("unicycle", 0.05, {}, (EffectSpec("input_coupling", "v", other.p), *ARCS)))
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(20, 3)), rng.normal(size=(20, 2))
    assert np.allclose(arm.step(x, u, arm.at_rest(20))[0], coupled.step(x, u, coupled.at_rest(20))[0], atol=1e-12)
    plainly = Found("sensor_lever_arm", "*", {"x": (0.0, None, None, "m"), "y": (0.2, None, None, "m")})
    assert _called(compose(ModelSpec("unicycle", 0.05)), plainly) == ()


@pytest.mark.slow
def test_of_one_input_all_inputs_is_no_other_name_that_a_person_is_told():
    rng = np.random.default_rng(4)
    robot = compose(
        ModelSpec(
            "joint",
            0.01,
            {"mass": 0.3},
            (EffectSpec("input_gain", "force", {"gain": 0.7}), EffectSpec("input_delay", "force", {"delay": 0.03})),
        )
    )
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 10)[:, None]
    x, hidden, rows = np.zeros((1, 2)), robot.at_rest(1), [np.zeros(2)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    found = trace(from_arrays(JOINT, [(np.array(rows) + rng.normal(size=(len(rows), 2)) * [1e-5, 1e-3], u)]), JOINT)
    assert {(e.name, e.channel) for e in found.ambiguous_with} >= {("input_delay", "*"), ("mass_change", "*")}
    assert "mass_change on *" in found.text()
    assert "input_delay on *" not in found.text()
    page = Page("", "")
    add_trace(page, found.to_json())
    assert "mass_change" in page.html()
    assert page.html().count("input_delay") == 1


@pytest.mark.slow
def test_of_two_names_for_one_rival_the_first_is_told_and_none_of_what_was_found():
    """A push ahead that fitted a little to the side, too, is a bias of the speed all the same."""
    found = trace(recordings([("input_gain", "w", {"gain": 0.8})], 1, steps=700, seed=3)[0], declared())
    bias = Found("input_bias", "v", {"bias": (0.02, None, None, "m/s")})
    instead = (("input_bias", "v"),)
    push = Found("constant_disturbance", "body", {"x": (0.02, None, None, "m/s"), "y": (1e-4, None, None, "m/s")}, instead)
    gain = Found("input_gain", "v", {"gain": (0.8, None, None, "-")}, instead)
    slip = Found("longitudinal_slip", "*", {"ratio": (0.2, None, None, "-")}, instead)
    told = replace(found, verdict="ambiguous", effects=(bias,), ambiguous_with=(push, gain, slip))
    assert told.rivals == (gain,)
    assert told.same(bias) == ()


LIMIT, BIAS = EffectSpec("input_saturation", "w", {"low": -0.5, "high": 0.5}), EffectSpec("input_bias", "force", {"bias": 0.2})
SLIDES = EffectSpec("lateral_slip", "*", {"coefficient": 0.1})
TURNS = Found("input_gain", "w", {"gain": (0.7, None, None, "")})
PUSHES = Found("input_gain", "force", {"gain": (0.7, None, None, "")})
SLOWLY = (EffectSpec("input_lag", "force", {"time_constant": 0.1}), EffectSpec("coulomb_friction", "qd", {"force": 0.1}))


@pytest.mark.parametrize(
    ("model", "found", "before", "after", "names"),
    [
        (UNICYCLE, TURNS, (), (LIMIT,), set()),
        (UNICYCLE, TURNS, (LIMIT,), (), {"track_scale"}),
        (UNICYCLE, TURNS, (), (SLIDES,), {"track_scale"}),
        (JOINT, PUSHES, (), (BIAS,), set()),
        (JOINT, PUSHES, (BIAS,), (), {"mass_change"}),
        (JOINT, PUSHES, SLOWLY, (), {"mass_change"}),
        (UNICYCLE, TURNS, (EffectSpec("input_delay", "*", {"delay": 3.0}),), (LIMIT,), set()),
        (UNICYCLE, TURNS, (), (LIMIT, EffectSpec("input_delay", "*", {"delay": 3.0})), set()),
        (UNICYCLE, TURNS, (), (EffectSpec("regime_change", "w", {"time": 9.0, "gain": 0.5}),), {"track_scale"}),
    ],
    ids=[
        "before a limit",
        "behind a limit",
        "beside slip",
        "before a bias",
        "behind a bias",
        "beside a lag and friction",
        "late, before a limit",
        "before a limit, late",
        "before a change",
    ],
)
def test_a_name_is_told_only_where_the_whole_model_goes_on_as_it_did(model, found, before, after, names):
    assert {e.name for e in _called(model, found, before, after) if e.channel != "*" or e.name != found.name} == names


def test_two_effects_that_share_another_name_both_have_it():
    first, second = (Found("input_bias", axis, {"bias": (0.3, 0.2, 0.4, "")}) for axis in ("ax", "ay"))
    both = [_called(PLANE, first), _called(PLANE, second)]
    assert [[(e.name, e.values, e.instead_of) for e in names if e.name == "constant_disturbance"] for names in both] == [
        [("constant_disturbance", {"x": 0.3, "y": 0.0}, (("input_bias", "ax"),))],
        [("constant_disturbance", {"x": 0.0, "y": 0.3}, (("input_bias", "ay"),))],
    ]


@pytest.mark.slow
def test_of_several_effects_each_rival_says_which_it_stands_for():
    """A robot that only ever turns at 0 or 1 rad/s does not tell a gain from a limit; what slows its speed is told."""
    rng = np.random.default_rng(4)
    u = np.zeros((1, 900, 2))
    u[0, :, 0] = np.repeat(rng.uniform(-0.15, 0.15, 45), 20)
    u[0, :, 1] = np.repeat(rng.integers(0, 2, 60), 15)
    effects = (*ROBOTARIUM, ("input_gain", "w", {"gain": 0.8}), ("input_lag", "v", {"time_constant": 0.2}))
    y = drive(rng, "unicycle", u, effects, DT, NOISE)
    found = trace(from_arrays(declared(), [(y[0], u[0])]), declared())
    assert found.verdict == "ambiguous"
    turning = [e for e in found.effects if e.channel in {"w", "theta"}]
    assert len(turning) == 1
    assert len(found.effects) == 2
    instead = {(e["name"], e["channel"]): [(f["name"], f["channel"]) for f in e["instead_of"]] for e in found.to_json()["ambiguous_with"]}
    assert len(instead) > 1
    assert set(map(tuple, instead.values())) == {((turning[0].name, turning[0].channel),)}
    assert found.text().count(f"in place of {turning[0].name} on {turning[0].channel}") == len(found.rivals)
    page = Page("", "")
    add_trace(page, found.to_json())
    assert page.html().count(f"or, in place of {turning[0].name} on {turning[0].channel}") == len(found.rivals)
