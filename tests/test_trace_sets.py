"""The tracer's test data: the same from the same seed, with physics that closed forms agree with, and a scorer that cannot be fooled."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from trace_sets import draws, outside, plants, scoring, targets
from trace_sets.again import errors_again
from trace_sets.families import FAMILIES, TUNING, UNTOUCHED, make
from trace_sets.library import physics
from trace_sets.making import EXACT, Draft, Missing, draw_missing
from trace_sets.noise import Noise
from trace_sets.outside_inputs import resonance
from trace_sets.recording import record
from trace_sets.same import names
from trace_sets.scale import PLANTS, draw_scale
from trace_sets.world import Start, World, rollout_errors

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

TOOLS = Path(__file__).parent.parent / "tools"
DT, PARTS = 0.02, 20


def driven(plant, u, *effects, x0=None, euler=False, runs=1):
    """(steps + 1, nx) without noise; u (steps, nu) on the grid."""
    world = World(plant, DT, PARTS, tuple(physics(plant, *e) if isinstance(e, tuple) else e for e in effects), euler)
    u = np.asarray(u, dtype=float).reshape(len(u), -1)
    grid = PARTS * np.arange(len(u) + 1)
    quiet = Noise("none", np.zeros(len(plant.states)))
    start = list(x0) if x0 is not None else [0.0] * len(plant.states)
    begins = [DT * len(u) * k for k in range(runs)]
    made = [record(world, grid, grid[:-1], u, quiet, start, np.random.default_rng(0), origin=t).y for t in begins]
    return made[-1]


def constant(steps, *values):
    return np.tile(values, (steps, 1))


# ---------------------------------------------------------------- reproducible


@pytest.mark.slow
@pytest.mark.parametrize("family", ["clean_jittered", "one", "outside", "tie", "fault"])
def test_the_same_seed_makes_the_same_bytes_and_another_one_others(family, tmp_path):
    texts = []
    for place, seed in (("a", 3), ("b", 3), ("c", 4)):
        (tmp_path / place).mkdir()
        texts.append(tuple(path.read_bytes() for path in make(family, seed).write(tmp_path / place, packed=True)))
    assert texts[0] == texts[1]
    assert texts[0][0] != texts[2][0]


def test_a_recording_says_nothing_of_its_truth(tmp_path):
    data, beside = make("one", 1).write(tmp_path)
    model = json.loads(beside.read_text())["model"]
    header = data.read_text().splitlines()[0].split(",")
    nominal = registry().get("models", model["name"])
    assert set(header) - {"segment"} == {"t", *nominal.states, *nominal.inputs}


def test_seeds_to_tune_on_and_untouched_ones_are_disjoint():
    assert not set(TUNING[:: len(TUNING) - 1]) & set(UNTOUCHED)
    assert TUNING.stop <= UNTOUCHED.start


@pytest.mark.slow
def test_every_family_is_driven_with_a_known_model():
    for family in set(FAMILIES) - {"long", "long_clean"}:
        given = make(family, 2)
        compose(
            ModelSpec(
                given.model["name"], given.model["dt"], given.model["parameters"], tuple(EffectSpec(**e) for e in given.model["effects"])
            )
        )
        assert given.truth["expect"] in {"clean", "one", "pair", "outside", "tie", "fault", "fault_effect", "bad", "reversed"}


# ---------------------------------------------------------------- physics


def test_a_constant_twist_is_a_circle_and_eulers_rule_is_eulers_rule():
    v, w, n = 0.7, 1.3, 150
    t = DT * np.arange(n + 1)
    arc = driven(plants.unicycle(), constant(n, v, w))
    assert np.allclose(arc[:, 0], v / w * np.sin(w * t), atol=1e-9)
    assert np.allclose(arc[:, 1], v / w * (1.0 - np.cos(w * t)), atol=1e-9)
    euler = driven(plants.unicycle(), constant(n, v, w), euler=True)
    assert np.allclose(euler[1:, 0], np.cumsum(DT * v * np.cos(w * t[:-1])), atol=1e-9)


def test_lag_and_delay_follow_their_step_responses():
    n, v = 100, 0.5
    t = DT * np.arange(n + 1)
    lagged = driven(plants.unicycle(), constant(n, v, 0.0), ("input_lag", "v", {"time_constant": 0.13}))
    assert np.allclose(lagged[:, 0], v * (t - 0.13 * (1.0 - np.exp(-t / 0.13))), atol=1e-9)
    late = driven(plants.unicycle(), constant(n, v, 0.0), ("input_delay", "v", {"delay": 0.0553}))
    assert np.allclose(late[5:, 0], v * (t[5:] - 0.0553), atol=1e-9)


def test_a_state_that_follows_its_input_shows_the_lag_at_the_end_of_the_step():
    robot = plants.differential_drive(0.1, 0.5)
    y = driven(robot, constant(60, 8.0, 8.0), ("input_lag", "cmd_left", {"time_constant": 0.05}))
    t = DT * np.arange(1, 61)
    assert np.allclose(y[1:, 3], 8.0 * (1.0 - np.exp(-t / 0.05)), atol=1e-6)
    assert np.allclose(y[1:, 4], 8.0, atol=1e-9)


def test_viscous_friction_and_drag_end_at_the_speed_at_which_they_balance_the_force():
    joint = plants.joint(2.0)
    y = driven(joint, constant(400, 3.0), ("viscous_friction", "qd", {"coefficient": 1.5}))
    t = DT * np.arange(401)
    assert np.allclose(y[:, 1], 2.0 * (1.0 - np.exp(-0.75 * t)), atol=1e-5)
    y = driven(joint, constant(400, 3.0), ("quadratic_drag", "qd", {"coefficient": 0.75}))
    assert y[-1, 1] == pytest.approx(2.0, abs=1e-3)


def test_dry_friction_stops_but_never_pushes():
    joint = plants.joint(2.0)
    y = driven(joint, constant(100, 0.0), ("coulomb_friction", "qd", {"force": 1.0}), x0=[0.0, 0.4])
    stop_s, way = 0.4 * 2.0 / 1.0, 0.4**2 * 2.0 / (2.0 * 1.0)
    assert np.all(np.abs(y[math.ceil(stop_s / DT) + 1 :, 1]) < 1e-12)
    assert y[-1, 0] == pytest.approx(way, abs=1e-4)
    below = driven(joint, constant(100, 1.4), ("stribeck_friction", "qd", {"force": 1.0, "static_force": 1.5, "velocity": 0.1}))
    assert np.all(below == 0.0)


def test_backlash_drags_half_a_play_behind_and_crosses_the_whole_play_on_return():
    s = np.concatenate([np.linspace(0.0, 1.0, 51), np.linspace(1.0, 0.0, 51)[1:]])
    y = driven(plants.unicycle(), np.column_stack([s, 0.0 * s]), ("input_backlash", "v", {"width": 0.3}))
    acted = np.diff(y[:, 0]) / DT
    assert acted[50] == pytest.approx(1.0 - 0.15)
    back = np.flatnonzero((acted < 0.85 - 1e-9) & (np.arange(len(acted)) > 50))[0]
    assert s[back] == pytest.approx(1.0 - 0.3, abs=0.021)


def test_limits_bands_and_rates_do_what_their_conventions_say():
    robot = plants.unicycle()

    def acted(value, *effect, steps=1):
        return np.diff(driven(robot, constant(steps, value, 0.0), effect)[:, 0])[-1] / DT

    assert acted(0.9, "input_saturation", "v", {"low": -0.5, "high": 0.6}) == pytest.approx(0.6)
    assert acted(-0.9, "input_deadband", "v", {"width": 0.2}) == pytest.approx(-0.7)
    assert acted(0.1, "input_deadband", "v", {"width": 0.2}) == 0.0
    assert acted(1.0, "input_rate_limit", "v", {"rate": 2.0}) == pytest.approx(0.5 * 2.0 * DT)  # the mean of a ramp
    assert acted(-1.0, "input_gain_asymmetry", "v", {"gain_positive": 0.5, "gain_negative": 0.8}) == pytest.approx(-0.8)
    assert acted(0.5, "quadratic_drag", "v", {"coefficient": 0.4}) == pytest.approx(0.5 - 0.4 * 0.25)


def test_a_wheel_that_is_clipped_turns_the_robot():
    y = driven(plants.unicycle(), constant(1, 0.5, 2.0), ("wheel_saturation", "*", {"speed": 0.6, "track": 0.2}))
    right, left = 0.6, 0.5 - 0.2
    assert y[1, 2] / DT == pytest.approx((right - left) / 0.2)


def test_sensors_measure_minus_true_and_a_lever_arm_draws_a_circle():
    robot = plants.unicycle()
    y = driven(
        robot, constant(100, 0.0, 1.0), ("sensor_lever_arm", "*", {"x": 0.3, "y": -0.1}), ("heading_offset", "theta", {"angle": 0.2})
    )
    assert np.allclose(np.hypot(y[:, 0], y[:, 1]), math.hypot(0.3, 0.1))
    assert y[0, 2] == pytest.approx(0.2)
    assert y[0, 0] == pytest.approx(0.3)
    world = World(robot, DT, PARTS, (physics(robot, "sensor_lever_arm", "*", {"x": 0.3, "y": -0.1}),))
    x = [1.0, 2.0, 0.7]
    assert np.allclose(world.true(world.measured(x, 0.0), 0.0), x)


def test_understeer_slip_and_wind_bend_the_path_as_their_formulas_say():
    car = plants.bicycle(1.2)
    y = driven(car, constant(50, 0.3, 4.0), ("understeer", "theta", {"coefficient": 0.05}))
    assert y[-1, 2] == pytest.approx(4.0 * math.tan(0.3) / (1.2 + 0.05 * 16.0))
    robot = plants.unicycle()
    y = driven(robot, constant(1, 1.0, 0.5), ("lateral_slip", "*", {"coefficient": 0.2}))
    assert y[1, 1] / DT == pytest.approx(0.2 * 0.5 + 0.5 * 0.5 * DT, abs=1e-4)
    y = driven(robot, constant(50, 0.0, 0.0), ("constant_disturbance", "body", {"x": 0.0, "y": 0.2}), x0=[0.0, 0.0, math.pi / 2])
    assert np.allclose(y[-1, :2], [-0.2, 0.0])


def test_what_pulls_downhill_goes_with_the_heading_that_a_fast_turn_has_on_the_way():
    w, n = 8.0, 100
    t = DT * np.arange(n + 1)
    y = driven(plants.unicycle(), constant(n, 0.0, w), ("gravity_slope", "*", {"x": 0.0, "y": 0.3}))
    assert np.allclose(y[:, 0], 0.3 * np.sin(w * t) ** 2 / (2.0 * w), atol=2e-6)  # 6e-4 off with the heading at the start of each part


def test_times_count_from_the_recordings_first_stamp_in_every_run():
    change = ("regime_change", "v", {"time": 1.5, "gain": 0.5})
    second = driven(plants.unicycle(), constant(50, 1.0, 0.0), change, runs=2)
    assert second[-1, 0] == pytest.approx(0.5 * 1.0 + 0.5 * 0.5)


def test_a_resonance_overshoots_as_its_damping_says():
    s = draw_scale(np.random.default_rng(1), ("unicycle",), n=1000, rate=50.0)
    effect, tokens, told = resonance(np.random.default_rng(5), s, 1.0)
    u = np.zeros((400, 2))
    u[:, s.plant.inputs.index(told["channel"])] = 1.0
    world = World(s.plant, 0.002, 10, (effect,))
    y = record(world, 10 * np.arange(401), 10 * np.arange(400), u, Noise("none", np.zeros(3)), [0.0] * 3, np.random.default_rng(0)).y
    peak = np.max(np.diff(y[:, 0 if told["channel"] == "v" else 2])) / 0.002
    z = told["damping"]
    assert told["rate"] * 0.8 > math.pi  # the peak is within the run
    assert peak == pytest.approx(1.0 + math.exp(-math.pi * z / math.sqrt(1.0 - z * z)), abs=0.02)
    assert tokens == {f"memory({told['channel']})"}


def test_there_are_fifteen_kinds_outside_the_library_and_each_can_be_drawn():
    assert len(outside.KINDS) >= 15
    for kind in outside.KINDS.values():
        for name in kind.plants:
            _, tokens, told = kind.draw(np.random.default_rng(0), draw_scale(np.random.default_rng(0), (name,)), 1.0)
            assert tokens
            assert json.dumps(told)


def test_without_effects_the_nominal_model_is_as_good_as_the_oracle():
    plant = plants.unicycle()
    world = World(plant, DT, PARTS)
    rows = PARTS * np.arange(201)
    noise = Noise("white", np.array([1e-3, 1e-3, 5e-3]))
    u = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 2))
    run = record(world, rows, rows[:-1], u, noise, [0.0] * 3, np.random.default_rng(0), ahead=20)
    assert rollout_errors(run.starts, world).ratio == pytest.approx(1.0, abs=1e-9)


def test_a_measured_speed_shows_what_acts_at_the_moment_that_it_is_read():
    plant, (f, a, phase) = plants.bicycle(0.33), (3.0, 0.5, 0.2)
    swing = physics(plant, "periodic_disturbance", "speed_cmd", {"frequency": f, "amplitude": a, "phase": phase})
    rows = PARTS * np.arange(51)
    run = record(
        World(plant, DT, PARTS, (swing,)),
        rows,
        rows[:-1],
        np.ones((50, 2)),
        Noise("none", np.zeros(4)),
        [0.0] * 4,
        np.random.default_rng(0),
    )
    assert np.allclose(run.y[1:, 3], 1.0 + a * np.sin(math.tau * f * DT * np.arange(1, 51) + phase), atol=1e-6)


def test_the_ratio_is_the_nominal_error_over_the_noise():
    plant, steps, sigma = plants.joint(1.0), 10, 0.02
    world = World(plant, DT, PARTS, (physics(plant, "input_gain", "force", {"gain": 2.0}),))
    u = np.full((2000, 1), 0.5)
    rows = PARTS * np.arange(2001)
    run = record(
        world, rows, rows[:-1], u, Noise("white", np.array([sigma, sigma])), [0.0, 0.0], np.random.default_rng(0), ahead=steps, rollouts=400
    )
    assert all(isinstance(s, Start) for s in run.starts)
    found = rollout_errors(run.starts, world.without_effects())
    speed_off = 0.5 * DT * steps  # the force that the nominal model does not know of
    assert found.oracle[1] == pytest.approx(sigma * math.sqrt(2.0), rel=4.0 / math.sqrt(2 * 400))
    assert found.nominal[1] == pytest.approx(math.hypot(speed_off, sigma * math.sqrt(2.0)), rel=4.0 / math.sqrt(2 * 400))


def test_coloured_noise_has_its_time_constant_and_outliers_their_share():
    rng = np.random.default_rng(0)
    pushes = np.array(Noise("coloured", np.zeros(3), push=np.array([0.3, 0.1]), memory=0.2).pushes(rng, 20_000, 0.02))
    correlation = np.mean(pushes[1:] * pushes[:-1], axis=0) / np.mean(pushes**2, axis=0)
    assert np.allclose(correlation, math.exp(-0.1), atol=5.0 * math.sqrt((1.0 - math.exp(-0.2)) / 20_000))
    e = Noise("outliers", np.ones(2), outliers=0.03, far=40.0).errors(rng, 20_000)
    share = np.mean(np.abs(e) > 10.0)
    assert share == pytest.approx(0.03 * 0.6, abs=5.0 * math.sqrt(0.018 / 20_000))


# ---------------------------------------------------------------- the library's own effects, against this physics


@pytest.mark.slow
@pytest.mark.parametrize("robot", PLANTS)
def test_the_library_means_the_same_by_its_effects(robot):
    """With the true effect and its true values, the project's model reaches what there is to be reached."""
    known = set(registry().names("effects"))
    base = draw_scale(np.random.default_rng(1), (robot,)).plant
    for name in sorted(known & set(draws.names(base))):
        rng = np.random.default_rng(zlib.crc32(f"{robot} {name}".encode()))
        s = draw_scale(rng, (robot,), n=400, rate=50.0)
        missing = draw_missing(rng, s, name, 1.0)
        if name == "integration_scheme":
            continue  # on arcs that are short the gain is little; the circle above is its test
        draft = Draft(
            s, Noise("none", np.zeros(len(s.plant.states))), "holds", missing=(missing,), declared=(EXACT,) if s.plant.pose else ()
        )
        told = draft.model()
        declared = tuple(EffectSpec(**e) for e in told["effects"])
        nominal = compose(ModelSpec(told["name"], told["dt"], told["parameters"], declared))
        full = compose(ModelSpec(told["name"], told["dt"], told["parameters"], (EffectSpec(**missing.told()), *declared)))
        before, after, _ = errors_again(draft, 0, nominal, full, None)["clean"]
        assert after < 0.1 * before + 1e-6, missing


@pytest.mark.parametrize("robot", PLANTS)
def test_names_for_the_same_thing_are_those_that_the_library_finds_by_trying(robot):
    classes = pytest.importorskip("s2r_runtime.effects.classes")
    s = draw_scale(np.random.default_rng(1), (robot,))
    told = Draft(s, Noise("none", np.zeros(len(s.plant.states))), "holds", declared=(EXACT,) if s.plant.pose else ())
    model = told.model()
    composed = compose(ModelSpec(model["name"], model["dt"], model["parameters"], tuple(EffectSpec(**e) for e in model["effects"])))
    for name in draws.names(s.plant):
        missing = draw_missing(np.random.default_rng(zlib.crc32(name.encode())), s, name, 1.0)
        ours = names(s.plant, missing, told)
        theirs = [found[:2] for found in classes.same(composed.nominal, missing.name, missing.channel, missing.p)]
        assert all(scoring.is_one_of(found, ours) for found in theirs), (missing, theirs)
        known = {n for n, _ in theirs} | {name}
        assert {n for n, _ in ours} <= known | {"sensor_offset", "heading_offset"}, (missing, ours, theirs)


# ---------------------------------------------------------------- the scorer


def effect(name, channel, **values):
    return {
        "name": name,
        "channel": channel,
        "parameters": {k: dict(zip(("value", "low", "high"), v, strict=True)) for k, v in values.items()},
    }


def answer(verdict, *effects, ties=(), left=(), faults=()):
    return {"verdict": verdict, "effects": list(effects), "ambiguous_with": list(ties), "depends_on": list(left), "faults": list(faults)}


GAIN = {
    "expect": "one",
    "effects": [{"name": "input_gain", "channel": "w", "parameters": {"gain": 0.8}}],
    "accepted": [[["input_gain", "w"], ["track_scale", None]]],
    "unreached": {},
}


@pytest.mark.parametrize(
    ("given", "word"),
    [
        (answer("traced", effect("input_gain", "w")), "right"),
        (answer("traced", effect("track_scale", "theta")), "right"),
        (answer("traced", effect("input_gain", "v")), "wrong"),
        (answer("traced", effect("input_bias", "w")), "wrong"),
        (answer("traced", effect("input_gain", "w"), effect("input_delay", "w")), "wrong"),
        (answer("traced", effect("input_gain", "w"), effect("track_scale", "theta")), "wrong"),
        (answer("ambiguous", effect("input_bias", "w"), ties=[effect("input_gain", "w")]), "tie"),
        (answer("ambiguous", effect("input_bias", "w"), ties=[effect("input_lag", "w")]), "wrong"),
        (answer("none"), "none"),
        (answer("unexplained", left=["w"]), "withheld"),
        (answer("sensor_fault"), "fault"),
    ],
)
def test_one_effect_is_right_only_by_its_name_or_a_name_for_the_same_thing(given, word):
    assert scoring.outcome(GAIN, given) == word


def test_one_of_a_pair_is_a_part_and_a_third_name_makes_it_wrong():
    truth = GAIN | {"expect": "pair", "accepted": [*GAIN["accepted"], [["input_delay", "v"]]]}
    assert scoring.outcome(truth, answer("traced", effect("input_delay", "v"), effect("track_scale", "theta"))) == "right"
    assert scoring.outcome(truth, answer("traced", effect("input_delay", "v"))) == "part"
    assert scoring.outcome(truth, answer("traced", effect("input_delay", "v"), effect("input_lag", "w"))) == "wrong"


def test_other_sets_of_effects_that_are_the_same_thing_are_right_too():
    truth = {
        "expect": "one",
        "accepted": [[["input_delay", "*"]]],
        "alternatives": [[[["input_delay", "v"]], [["input_delay", "w"]]]],
    }
    assert scoring.outcome(truth, answer("traced", effect("input_delay", "v"), effect("input_delay", "w"))) == "right"
    assert scoring.outcome(truth, answer("traced", effect("input_delay", "v"), effect("input_lag", "w"))) == "wrong"


def test_a_name_on_clean_data_is_an_alarm_and_noise_may_be_called_coloured_only_where_it_is():
    clean = {"expect": "clean", "noise": "white"}
    assert scoring.outcome(clean, answer("none", left=["noise"])) == "clean"
    assert scoring.outcome(clean, answer("traced", effect("input_gain", "w"))) == "alarm"
    assert scoring.outcome(clean, answer("unexplained", left=["noise"])) == "alarm"
    assert scoring.outcome(clean | {"noise": "coloured"}, answer("unexplained", left=["noise"])) == "clean"
    assert scoring.outcome(clean | {"noise": "coloured"}, answer("unexplained", left=["noise", "w"])) == "alarm"
    assert scoring.outcome(clean, answer("sensor_fault", faults=[{"kind": "spike"}])) == "alarm"
    assert scoring.outcome(clean | {"noise": "outliers"}, answer("sensor_fault", faults=[{"kind": "spike"}])) == "clean"


def test_a_name_for_what_the_library_lacks_is_false_unless_it_says_that_more_is_left():
    truth = {"expect": "outside", "depends_on": ["memory(w)"]}
    assert scoring.outcome(truth, answer("traced", effect("input_lag", "w"))) == "false_name"
    assert scoring.outcome(truth, answer("traced", effect("input_lag", "w"), left=["noise"])) == "false_name"
    assert scoring.outcome(truth, answer("traced", effect("input_lag", "w"), left=["memory(w)"])) == "named_flagged"
    assert scoring.outcome(truth, answer("unexplained", left=["w"])) == "flagged"
    assert scoring.depends_right(truth, answer("unexplained", left=["memory(w)", "w"]))
    assert not scoring.depends_right(truth, answer("unexplained", left=["w", "memory(w)"]))


def test_certainty_about_what_cannot_be_separated_is_overclaimed():
    truth = {"expect": "tie", "accepted": [[["input_gain", "v"], ["input_bias", "v"]]]}
    assert scoring.outcome(truth, answer("traced", effect("input_gain", "v"))) == "overclaimed"
    assert scoring.outcome(truth, answer("ambiguous", effect("input_gain", "v"), ties=[effect("input_bias", "v")])) == "tie"


def test_a_fault_must_be_told_where_and_when_it_is():
    truth = {
        "expect": "fault",
        "rate": 50.0,
        "true_faults": [{"kinds": ["frozen"], "channel": "x", "from_s": 3.0, "to_s": 5.0}],
    }

    def told(kind, channel, begin, end):
        return {"kind": kind, "channel": channel, "from_s": begin, "to_s": end}

    assert scoring.outcome(truth, answer("sensor_fault", faults=[told("frozen", "x", 3.02, 5.0)])) == "found"
    assert scoring.outcome(truth, answer("none", faults=[told("frozen", "x", 3.02, 5.0)])) == "located"
    assert scoring.outcome(truth, answer("sensor_fault", faults=[told("frozen", "y", 3.02, 5.0)])) == "missed"
    assert scoring.outcome(truth, answer("sensor_fault", faults=[told("frozen", "x", 6.0, 8.0)])) == "missed"
    assert scoring.outcome(truth, answer("traced", effect("input_gain", "v"))) == "wrong"


def test_an_interval_covers_only_if_the_truth_lies_in_it_and_is_not_asked_for_by_another_name():
    assert scoring.covered(GAIN, answer("traced", effect("input_gain", "w", gain=(0.81, 0.79, 0.82)))) == [("input_gain.gain", True)]
    assert scoring.covered(GAIN, answer("traced", effect("input_gain", "w", gain=(0.85, 0.82, 0.88)))) == [("input_gain.gain", False)]
    assert scoring.covered(GAIN, answer("traced", effect("track_scale", "theta", gain=(0.81, 0.79, 0.82)))) == []
    assert scoring.covered(GAIN, answer("unexplained")) == []


# ---------------------------------------------------------------- the table


def record_of(family, outcome, **more):
    base = {
        "family": family,
        "expect": "one",
        "outcome": outcome,
        "ratio": 3.0,
        "n": 400,
        "cpu_s": 0.1,
        "covered": [],
        "truth": [],
        "verdict": "none",
    }
    return base | {"depends_right": False, "seed": 0} | more


def row(records, what):
    return next(r for r in targets.rows(records) if r.what.startswith(what))


def test_the_exact_interval_of_a_share():
    low, high = targets.clopper_pearson(0, 100)
    assert (low, high) == (0.0, pytest.approx(1.0 - 0.025 ** (1 / 100)))
    low, high = targets.clopper_pearson(9, 10)
    assert low == pytest.approx(0.55498, abs=1e-4)
    assert high == pytest.approx(0.99747, abs=1e-4)


def test_a_wrong_name_is_counted_as_wrong_and_a_target_that_is_missed_is_not_met():
    records = [record_of("one", "right")] * 94 + [record_of("one", "wrong")] * 6
    assert row(records, "one effect that matters").met
    assert row(records, "one effect that matters").found == "94.0%"
    assert row(records, "one effect: wrong name").met is False
    assert row(records, "one effect: wrong name").found == "6.0%"
    assert row(records, "two effects").met is None


def test_weak_effects_are_judged_by_another_measure_than_strong_ones():
    records = [record_of("weak", "none", ratio=1.2)] * 9 + [record_of("weak", "withheld", ratio=1.2)]
    assert row(records, "one weak effect").found == "90.0%"
    assert row(records, "one effect that matters").met is None
    assert row([record_of("weak", "none", ratio=1.02)], "one weak effect").met is None


def test_errors_reached_are_shares_of_what_the_oracle_reaches():
    again = {"noisy": [3.0, 1.2, 1.0], "clean": [2.8, 0.6, 0.0]}
    assert targets.reached(record_of("one", "right", again=again)) == pytest.approx(0.9)
    worse = record_of("one", "right", verdict="traced", again={"noisy": [1.0, 1.1, 0.9], "clean": [0.5, 0.7, 0.0]})
    assert row([worse], "repaired model worse").met is False


def test_a_drive_on_which_nothing_can_be_reached_is_no_share():
    """A limit that it never meets: nominal, repaired and true models do the same."""
    rounded = {"noisy": [0.13076694009739698, 0.13076694009739698, 0.13076694009739697], "clean": [9e-15, 9e-15, 0.0]}
    assert targets.reached(record_of("one", "right", again=rounded)) is None
    assert row([record_of("one", "right", verdict="traced", again=rounded)], "error reduction reached, 10th").met is None


def test_a_crash_is_never_left_out():
    records = [record_of("clean", "clean")] * 99 + [record_of("clean", "crash")]
    assert row(records, "crashed").met is False
    assert row(records, "false alarms, clean, white").found == "0.0%"


@pytest.mark.slow
def test_the_bench_reads_its_own_records_and_prints_failures_in_a_line_each(tmp_path):
    common = {"robot": "unicycle", "rate": 50.0, "law": "holds", "layout": "grid", "noise": "white", "runs": 1, "euler": False}
    wrong = record_of("one", "wrong", seed=7, verdict="traced", effects=[effect("input_bias", "w", bias=(0.1, 0.0, 0.2))], **common)
    wrong["truth"] = GAIN["effects"]
    right = record_of("one", "right", verdict="traced", **common)
    file = tmp_path / "records.json"
    file.write_text(json.dumps(wrong) + "\n" + json.dumps(right) + "\n")
    command = [sys.executable, str(TOOLS / "bench_trace.py"), "--from", str(file), "--failures", "--by", "effect"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    lines = [line for line in shown.splitlines() if line.startswith("wrong")]
    assert len(lines) == 1
    assert "one:7" in lines[0]
    assert "TRUE input_gain(w)[0.8]" in lines[0]
    assert "SAID traced input_bias(w)[0.1]" in lines[0]
    assert "50.0%" in shown


def test_missing_effects_are_plain_data():
    assert json.loads(json.dumps(Missing("input_gain", "v", {"gain": 0.9}).told()))["parameters"] == {"gain": 0.9}
