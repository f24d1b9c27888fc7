"""What was found goes by other names on some models: they stand beside it with its numbers, and are no tie."""

from dataclasses import replace

import numpy as np
import pytest
from trace_robots import DT, NOISE, ROBOTARIUM, declared, drive, recordings

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.report.page import Page
from s2r_runtime.report.trace_section import add_trace
from s2r_runtime.trace.dataset import from_arrays
from s2r_runtime.trace.found import Found
from s2r_runtime.trace.same_thing import other_names
from s2r_runtime.trace.tracer import trace

ARCS = (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)
UNICYCLE = compose(ModelSpec("unicycle", 0.05, {}, ARCS))
JOINT = compose(ModelSpec("joint", 0.01, {"mass": 0.3}))
PLANE = compose(ModelSpec("double_integrator", 0.05))


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
    told = {(e.name, e.channel): {name: value[:3] for name, value in e.parameters.items()} for e in other_names(model, found)}
    assert told == {
        key: {name: tuple(v if v is None else pytest.approx(v) for v in value) for name, value in p.items()} for key, p in called.items()
    }


@pytest.mark.parametrize("end", [None, -2.0])
def test_an_end_that_is_none_by_the_other_name_is_not_told(end):
    """An interval without an end, and a gain below zero, which no mass makes."""
    (mass,) = other_names(JOINT, Found("input_gain", "force", {"gain": (0.8, end, 1.0, "-")}))
    assert mass.parameters["ratio"][:3] == (pytest.approx(1.25), None, None)


def test_by_each_name_the_model_does_the_same():
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(20, 2)), rng.normal(size=(20, 1))
    found = Found("input_gain", "force", {"gain": (0.8, None, None, "-")})
    steps = []
    for e in (found, *other_names(JOINT, found)):
        model = compose(ModelSpec("joint", 0.01, {"mass": 0.3}, (EffectSpec(e.name, e.channel, e.values),)))
        steps.append(model.step(x, u, model.at_rest(20))[0])
    assert len(steps) == 2
    assert np.allclose(steps[0], steps[1], rtol=1e-12)


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
    told = other_names(UNICYCLE, Found("sensor_lever_arm", "*", {"x": (0.0, None, None, "m"), "y": (0.2, 0.1, 0.3, "m")}))
    assert [(e.name, e.channel, e.values) for e in told] == [("input_coupling", "v", {"from": "w", "coefficient": pytest.approx(-0.2)})]
    other = AppliedEffect(registry().get("effects", "input_coupling"), "v", told[0].values)
    coupled = compose(ModelSpec("unicycle", 0.05, {}, (EffectSpec("input_coupling", "v", other.p), *ARCS)))
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(20, 3)), rng.normal(size=(20, 2))
    assert np.allclose(arm.step(x, u, arm.at_rest(20))[0], coupled.step(x, u, coupled.at_rest(20))[0], atol=1e-12)
    assert (
        other_names(compose(ModelSpec("unicycle", 0.05)), Found("sensor_lever_arm", "*", {"x": (0.0, 0, 0, "m"), "y": (0.2, 0, 0, "m")}))
        == ()
    )


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


def test_a_rival_with_numbers_of_its_own_is_another_thing():
    """A point before the middle, too, is no coupling, although one beside it is."""
    found = trace(recordings([("input_gain", "w", {"gain": 0.8})], 1, steps=700, seed=3)[0], declared())
    coupling = Found("input_coupling", "v", {"from": ("w", None, None, ""), "coefficient": (-0.2, None, None, "m")})
    beside = Found("sensor_lever_arm", "*", {"x": (0.0, None, None, "m"), "y": (0.2, None, None, "m")})
    before = replace(beside, parameters={**beside.parameters, "x": (0.01, None, None, "m")})
    for other, rivals in ((beside, ()), (before, (before,))):
        told = replace(found, verdict="ambiguous", effects=(coupling,), ambiguous_with=(other,))
        assert told.rivals == rivals
        assert told.same(coupling) == (() if rivals else (other,))


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
