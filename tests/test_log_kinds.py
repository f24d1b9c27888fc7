"""Test data of the kinds that logs of real robots are: the same from the same seed, with truths that agree with the recording."""

from __future__ import annotations

import csv
import json
import math
from typing import Any

import numpy as np
import pytest
from trace_sets import log_scoring, plants, scoring, targets
from trace_sets.families import FAMILIES, make
from trace_sets.log_kinds import LOG_KINDS
from trace_sets.making import EXACT, Draft, Missing
from trace_sets.newer import KINDS, LARGE, robot
from trace_sets.newer_effects import NEWER, newer_physics
from trace_sets.noise import Noise
from trace_sets.recording import TraceSet
from trace_sets.world import Moment, World

from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec

EXPECTED = {"clean", "one", "pair", "fault", "fault_effect", "reversed", "unpromised"}
SEEDS = range(3)


def columns(given: TraceSet, folder: Any) -> dict[str, list[str]]:
    data, _ = given.write(folder)
    with data.open() as read:
        rows = list(csv.DictReader(read))
    return {name: [row[name] for row in rows] for name in rows[0]}


def model_of(given: TraceSet) -> ComposedModel:
    m = given.model
    return compose(ModelSpec(m["name"], m["dt"], m["parameters"], tuple(EffectSpec(**e) for e in m["effects"])))


@pytest.mark.parametrize("family", LOG_KINDS)
def test_the_same_seed_makes_the_same_bytes_and_another_one_others(family, tmp_path):
    texts = []
    for place, seed in (("a", 1), ("b", 1), ("c", 2)):
        (tmp_path / place).mkdir()
        texts.append(tuple(path.read_bytes() for path in make(family, seed).write(tmp_path / place)))
    assert texts[0] == texts[1]
    assert texts[0][0] != texts[2][0]
    assert FAMILIES[family] is LOG_KINDS[family]


@pytest.mark.parametrize("family", LOG_KINDS)
def test_a_recording_has_the_columns_of_its_model_and_a_complete_truth(family, tmp_path):
    for seed in SEEDS:
        given = make(family, seed)
        nominal, read, truth = model_of(given), columns(given, tmp_path), given.truth
        assert given.recording is not None
        assert set(read) - {"segment"} == {"t", *nominal.states, *nominal.inputs} - set(given.recording.unseen)
        assert truth["expect"] in EXPECTED
        assert bool(truth["effects"]) == (truth["expect"] in {"one", "pair", "fault_effect", "reversed"})
        if truth["effects"]:
            own = [(e["name"], e["channel"]) for e in truth["effects"]]
            assert scoring.matching(own, truth["accepted"]) == list(range(len(own)))
            compose(
                ModelSpec(
                    given.model["name"], given.model["dt"], given.model["parameters"], tuple(EffectSpec(**e) for e in truth["effects"])
                )
            )
        assert ("true_faults" in truth) == truth["expect"].startswith("fault")
        assert json.loads(json.dumps(truth, default=float))["n"] >= 200


@pytest.mark.slow
@pytest.mark.parametrize("family", LOG_KINDS)
def test_each_family_has_sets_with_an_effect_and_clean_ones(family):
    truths = [make(family, seed).truth for seed in range(12)]
    assert {bool(t["effects"]) for t in truths} == {True, False}
    matters = [t["ratio"] for t in truths if t["effects"]]
    assert np.mean(np.array(matters) >= (LARGE.low if family == "newer" else 1.5)) >= 0.8


# ---------------------------------------------------------------- what each kind promises of its columns


def of_kind(family: str, *kinds: str) -> TraceSet:
    return next(g for g in (make(family, seed) for seed in range(40)) if g.truth["kind"] in kinds)


def test_a_delayed_heading_fits_the_course_best_when_it_is_moved_back_by_its_delay():
    given = next(g for g in (make("late_heading", seed) for seed in range(60)) if g.truth["kind"] == "heading" and not g.truth["effects"])
    run = given.recording.runs[0]
    step = np.diff(run.y[:, :2], axis=0)
    length = np.hypot(*step.T)
    middle = 0.5 * (run.t[1:] + run.t[:-1])

    def sideways(delay: float) -> float:
        heading = np.interp(middle + delay, run.t, np.unwrap(run.y[:, 2]))
        across = step[:, 1] * np.cos(heading) - step[:, 0] * np.sin(heading)
        return float(np.mean(across[length > 0] ** 2))

    true = given.truth["delayed"]["seconds"]
    assert 0.02 <= true <= 0.31
    assert sideways(true) < 0.5 * sideways(0.0)
    assert sideways(true) < sideways(2.0 * true)


def test_a_delayed_speed_is_the_change_of_its_position_some_time_before():
    given = of_kind("late_speed", "delay", "filter")
    run, s = given.recording.runs[0], given.draft.scale
    j = s.plant.axes if not s.plant.pose else None
    if j is None:
        pytest.skip("a car")
    rate, middle = np.diff(run.y[:, 0]) / np.diff(run.t), 0.5 * (run.t[1:] + run.t[:-1])

    def off(delay: float) -> float:
        return float(np.mean((np.interp(middle + delay, run.t, run.y[:, j]) - rate) ** 2))

    assert off(given.truth["delayed"]["seconds"]) < off(0.0)


def test_a_measured_torque_is_what_accelerates_the_joint_and_what_friction_takes():
    given = of_kind("measured_torque", "both")
    run, plant = given.recording.runs[0], given.draft.scale.plant
    v = run.y[:, 1]
    width = max(round(0.1 / given.draft.scale.dt), 2)
    force = np.array([np.mean(run.u[k : k + width, 0]) for k in range(0, len(v) - width, width)])
    change = np.array([v[k + width] - v[k] for k in range(0, len(v) - width, width)]) / (width * given.draft.scale.dt)
    speed = np.array([np.mean(v[k : k + width]) for k in range(0, len(v) - width, width)])
    p = {k: value for e in given.truth["effects"] for k, value in e["parameters"].items()}
    moving = np.abs(speed) > 0.3 * np.max(np.abs(speed))
    expected = plant.parameters["mass"] * change + p["coefficient"] * speed + p["force"] * np.sign(speed)
    assert np.std((force - expected)[moving]) < 0.15 * np.std(force)
    assert np.allclose(run.u / given.truth["quantum"], np.round(run.u / given.truth["quantum"]))


def test_rounded_states_have_their_decimals(tmp_path):
    given = of_kind("rounded", "2 decimals", "3 decimals")
    decimals = int(given.truth["kind"][0])
    for name, cells in columns(given, tmp_path).items():
        if name in given.draft.scale.plant.states and name != "theta":
            assert all(abs(float(c) - round(float(c), decimals)) < 1e-7 for c in cells if c)


def test_runs_begin_at_nearly_one_place():
    given = make("same_place", 0)
    starts = np.array([run.y[0, :2] for run in given.recording.runs])
    assert len(starts) >= 8
    assert np.all(np.std(starts, axis=0) < 40.0 * given.draft.noise.sigma[:2])


def test_commands_change_between_samples_and_the_table_has_the_last_one():
    given = make("between_samples", 0)
    run = given.recording.runs[0]
    assert np.array_equal(run.t, run.t_u)
    assert len(run.u) == len(run.y)
    steps = np.diff(run.t)
    assert steps == pytest.approx(np.full(len(steps), given.draft.scale.dt), abs=1e-6)


def test_positions_alone_are_recorded_and_the_faults_lie_in_them():
    for seed in range(6):
        given = make("position_faults", seed)
        plant = given.draft.scale.plant
        assert given.recording.unseen == plant.states[plant.axes :]
        for fault in given.truth.get("true_faults", ()):
            assert fault["channel"] in plant.states[: plant.axes]
            assert 0.0 <= fault["from_s"] <= fault["to_s"] <= given.recording.runs[0].t[-1]


# ---------------------------------------------------------------- physics of the newer effects


@pytest.mark.parametrize("name", KINDS)
def test_the_library_means_the_same_by_its_newer_effects(name):
    """One step and a hundred of them, from the same state under the same inputs. The gap of a gear is closed on one side at the start."""
    kind = KINDS[name]
    for which in kind.robots:
        rng = np.random.default_rng(5)
        s = robot(rng, which)
        missing = Missing(name, kind.channel, kind.draw(rng, s, 1.0))
        rule: dict[str, Any] = {"declared": (EXACT,)} if s.plant.pose and not s.plant.file else {}
        spec = Draft(s, Noise("none", np.zeros(len(s.plant.states))), "holds", missing=(missing,), **rule).model()
        effects = (EffectSpec(missing.name, missing.channel, missing.p), *(EffectSpec(**e) for e in spec["effects"]))
        with_it = compose(ModelSpec(spec["name"], spec["dt"], spec["parameters"], effects))
        without = compose(ModelSpec(spec["name"], spec["dt"], spec["parameters"], effects[1:]))
        steps = 100
        u = np.array(
            [[r.size * float(rng.uniform(0.4, 1.0)) * (1.0 if (k // 25) % 2 == 0 else -1.0) for r in s.ranges] for k in range(steps)]
        )
        world = World(s.plant, s.dt, s.parts, (newer_physics(s.plant, name, kind.channel, missing.p),))
        moment = Moment(world, [[] for _ in s.ranges], [0.2, 0.1, 0.4, 0.0, 0.0][: len(s.plant.states)])
        y = [moment.read()]
        for row in u:
            for line, value in zip(moment.u, row, strict=True):
                line.extend([float(value)] * s.parts)
            for _ in range(s.parts):
                moment.part()
            y.append(moment.read())
        true, errors = np.array(y), []
        for model in (with_it, without):
            hidden, off = model.at_rest(1), []
            for k in range(steps):
                mean, end, hidden = model.act(u[k : k + 1], hidden)
                if k >= steps // 2:  # a gear's gap is known after the first reversals
                    off.append(
                        model.difference(true[k + 1 : k + 2].copy(), model.advance(true[k : k + 1], mean, mean if mean is end else end))
                    )
            errors.append(float(np.sqrt(np.mean(np.square(off)))))
        assert errors[0] < (0.5 if name == "gear_backlash" else 0.1) * errors[1], (name, which, errors)


def test_a_gear_lets_go_for_the_time_that_the_motor_needs_and_then_passes_its_momentum_on():
    plant, width = plants.joint(2.0), 0.02
    world = World(plant, 0.01, 20, (newer_physics(plant, "gear_backlash", "force", {"width": width}),))
    moment = Moment(world, [[]], [0.0, 0.0])
    speeds = []
    for k in range(80):
        moment.u[0].extend([4.0 if k < 10 else -4.0] * 20)
        for _ in range(20):
            moment.part()
        speeds.append(moment.x[1])
    crossing = math.sqrt(2.0 * width / (4.0 / 2.0))
    assert speeds[9] == pytest.approx(0.2)
    assert speeds[9 + int(0.9 * crossing / 0.01)] == pytest.approx(0.2)
    assert speeds[79] == pytest.approx(0.2 - 0.7 * 2.0, abs=0.01)


def test_every_newer_effect_has_its_physics():
    assert set(KINDS) - {"track_scale"} == set(NEWER)


# ---------------------------------------------------------------- the score


def answer(verdict: str, *effects: tuple[str, str, dict[str, tuple[float, float, float]]], **more: Any) -> dict[str, Any]:
    found = [
        {"name": n, "channel": c, "parameters": {k: dict(zip(("value", "low", "high"), v, strict=True)) for k, v in p.items()}}
        for n, c, p in effects
    ]
    return {"verdict": verdict, "effects": found, "ambiguous_with": [], "depends_on": [], "faults": [], **more}


RATIO: dict[str, Any] = {
    "expect": "one",
    "effects": [{"name": "steering_ratio", "channel": "steer_cmd", "parameters": {"ratio": 0.8}}],
    "accepted": [[["steering_ratio", "steer_cmd"], ["input_gain", "steer_cmd"]]],
    "unreached": {},
    "close": True,
    "rate": 50.0,
    "noise": "white",
}


@pytest.mark.parametrize(("value", "word"), [((0.83, 0.82, 0.84), "right"), ((0.86, 0.79, 0.93), "right"), ((0.86, 0.85, 0.87), "off")])
def test_a_value_is_right_within_a_fifth_of_the_effect_or_within_its_interval(value, word):
    assert scoring.outcome(RATIO, answer("traced", ("steering_ratio", "steer_cmd", {"ratio": value}))) == word


def test_a_fault_that_is_not_there_is_an_alarm_or_wrong():
    late = [{"kind": "late", "channel": "theta", "from_s": 0.0, "to_s": 9.0}]
    right = ("steering_ratio", "steer_cmd", {"ratio": (0.8, 0.79, 0.81)})
    assert scoring.outcome(RATIO | {"no_fault": ["late"]}, answer("traced", right, faults=late)) == "wrong"
    clean = {"expect": "clean", "noise": "white", "no_fault": ["late"]}
    assert scoring.outcome(clean, answer("none", faults=late)) == "alarm"
    assert scoring.outcome(clean, answer("none")) == "clean"


def test_a_wrong_sign_may_be_left_unexplained_but_not_explained_by_something_else():
    truth = RATIO | {"expect": "reversed", "effects": [{"name": "input_gain", "channel": "w", "parameters": {"gain": -1.0}}]}
    truth["accepted"] = [[["input_gain", "w"]]]
    assert scoring.outcome(truth, answer("unexplained", depends_on=["w"])) == "honest"
    assert scoring.outcome(truth, answer("traced", ("input_gain", "w", {"gain": (-1.0, -1.1, -0.9)}))) == "right"
    assert scoring.outcome(truth, answer("traced", ("input_delay", "w", {"delay": (0.1, 0.0, 0.2)}))) == "wrong"


def test_where_nothing_is_promised_only_a_name_is_false():
    truth = RATIO | {"expect": "unpromised", "effects": [], "accepted": []}
    assert scoring.outcome(truth, answer("unexplained")) == "honest"
    assert scoring.outcome(truth, answer("traced", ("input_lag", "speed_cmd", {}))) == "false_name"


def test_a_delay_is_right_within_half_a_sample():
    truth = {"expect": "fault", "rate": 20.0, "delayed": {"kind": "heading", "states": ["theta"], "seconds": 0.1}}
    assert log_scoring.delay_right(truth, answer("sensor_fault", states_late={"theta": 0.12}))
    assert log_scoring.delay_right(truth, answer("sensor_fault", states_late={"theta": 0.13})) is False
    assert log_scoring.delay_right(truth, answer("none", states_late=None)) is False
    assert log_scoring.delay_right({"delayed": {"kind": "none", "states": [], "seconds": 0.0}}, answer("none")) is None


def test_each_family_that_was_run_has_its_lines_in_the_table():
    base = {
        "family": "rounded",
        "ratio": 3.0,
        "n": 400,
        "cpu_s": 0.1,
        "covered": [],
        "truth": [],
        "verdict": "none",
        "depends_right": False,
        "seed": 0,
    }
    records = [base | {"expect": "clean", "outcome": "clean"}, base | {"expect": "one", "outcome": "off"}]
    made = [r for r in targets.rows(records) if r.what.startswith(("rounded", "  an effect"))]
    assert [(r.n, r.met) for r in made] == [(1, True), (1, False), (1, False)]
    assert not [r for r in targets.rows([]) if r.what.startswith("rounded")]
