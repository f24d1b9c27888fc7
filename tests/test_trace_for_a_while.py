"""What comes and goes, what goes in steps, what grows with time, and what may be wrong elsewhere: no confident name, no `nothing`."""

import math

import numpy as np
import pytest

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics import lack_of_fit
from s2r_runtime.trace.diagnostics.lack_of_fit import left_of
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, insert, problem
from s2r_runtime.trace.hypotheses.disturbances import _staying_wild, episodes
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection.scores import Scored
from s2r_runtime.trace.selection.ties import representative

DT, PARTS = 0.05, 10
NOISE = np.array([0.0008, 0.0008, 0.002])


def _unicycle(rng, u, share=lambda k, x: 1.0, scheme="exact"):
    """(T + 1, 3) measured: `share` of the speed that is commanded, on arcs or by Euler's rule."""
    x = np.zeros(3)
    rows = [x]
    for k, (v, w) in enumerate(u):
        v = v * share(k, x)
        parts = PARTS if scheme == "exact" else 1
        x = x.copy()
        for _ in range(parts):
            h = DT / parts
            x += h * np.array([v * math.cos(x[2]), v * math.sin(x[2]), w])
        rows.append(x)
    return np.array(rows) + rng.normal(size=(len(u) + 1, 3)) * NOISE


def _held(rng, steps, low, high, hold=20):
    return np.repeat(rng.uniform(low, high, (steps // hold + 1, len(low))), hold, axis=0)[:steps]


def _traced(y, u, scheme="euler"):
    model = compose(ModelSpec("unicycle", DT, {}, ()))
    return trace(from_arrays(model, [(y, u)]), model)


def _on_a_wet_floor():
    """Two stretches of time on which the wheels slip, in places where it never comes back to."""
    rng = np.random.default_rng(3)
    u = np.column_stack([rng.uniform(0.2, 0.4, 800), 0.15 * np.sin(0.02 * np.arange(800))])
    return _unicycle(rng, u, lambda k, x: 0.55 if 300 <= k < 340 or 610 <= k < 640 else 1.0, "euler"), u


@pytest.mark.slow
def test_a_stretch_of_wet_floor_is_no_noise():
    result = _traced(*_on_a_wet_floor())
    assert result.verdict == "unexplained"
    assert {"time", "time*v", "position"} & set(result.depends_on)


def test_what_comes_and_goes_is_told_by_words_that_users_know(monkeypatch):
    """A dictionary of waves is one of time."""
    monkeypatch.setattr(lack_of_fit, "may_depend_on", lambda left, found, dictionaries: ("wave", "time", "v"))
    model = compose(ModelSpec("unicycle", DT, {}, ()))
    data = from_arrays(model, [_on_a_wet_floor()])
    given = problem(data, steps_of(data))
    nominal = evaluate(given, model)
    found = lack_of_fit.lack_of_fit(lack_of_fit.Looks(left_of(given, nominal)), nominal, 20)
    assert found.for_a_while
    assert found.tokens == ("time", "v")


@pytest.mark.parametrize("seed", range(6))
def test_a_push_that_wanders_slowly_is_no_episode(seed):
    """At 1 kHz a force that wanders in a tenth of a second looks neither white nor like an autoregression of four milliseconds."""
    rng = np.random.default_rng(seed)
    dt, steps = 0.001, 1400
    u = _held(rng, steps, [-2.0], [2.0], 150)
    push, x = 0.0, np.zeros(2)
    rows = [x]
    for k in range(steps):
        push += -push * dt / 0.1 + 0.3 * math.sqrt(2.0 * dt / 0.1) * rng.normal()
        x = x + dt * np.array([x[1] + 0.5 * dt * (u[k, 0] + push), u[k, 0] + push])
        rows.append(x)
    y = np.array(rows) + rng.normal(size=(steps + 1, 2)) * [1e-4, 2e-4]
    model = compose(ModelSpec("joint", dt, {"mass": 1.0}, ()))
    data = from_arrays(model, [(y, u)])
    given = problem(data, steps_of(data))
    assert episodes(left_of(given, evaluate(given, model))) is None


@pytest.mark.slow
def test_commands_that_are_lost_for_a_while_are_no_matter_of_another_input():
    """Six times a car's speed is nothing for six steps. These are wild, as it is measured well."""
    rng = np.random.default_rng(6)
    steps = 1500
    t = 0.033 * np.arange(steps)
    u = np.column_stack([0.4 * np.sin(0.8 * t) * np.cos(0.23 * t), 0.7 + 0.5 * np.sin(0.5 * t + 1.0)])
    model = compose(ModelSpec("bicycle", 0.033, {"wheel_base": 0.5}, ()))
    robot = u.copy()
    for begin in (100, 340, 610, 800, 1130, 1380):
        robot[begin : begin + 6, 1] = 0.0
    x, hidden = np.zeros((1, 4)), model.at_rest(1)
    rows = [x[0]]
    for k in range(steps):
        x, hidden = model.step(x, robot[k : k + 1], hidden)
        rows.append(x[0])
    wild = rng.random((steps + 1, 4)) < 0.01
    y = np.array(rows) + rng.normal(size=(steps + 1, 4)) * [0.002, 0.002, 0.002, 0.001] * np.where(wild, 15.0, 1.0)
    result = trace(from_arrays(model, [(y, u)]), model)
    assert result.verdict in {"unexplained", "sensor_fault"}
    assert result.depends_on[:1] in {("time*speed_cmd",), ("speed_cmd",), ("time",), ()}


@pytest.mark.parametrize("seed", [2, 5])
@pytest.mark.slow
def test_a_wheel_that_sticks_now_and_then_is_no_noise(seed):
    """It follows its command only where that changes by more than a little: a few commands are not carried out, each time another one."""
    rng = np.random.default_rng(seed)
    model = compose(ModelSpec("differential_drive", DT, {"wheel_radius": 0.05, "track": 0.3}, ()))
    u = np.repeat(rng.uniform(-6.0, 6.0, (200, 2)), rng.integers(4, 16, 200), axis=0)[:1200]
    done, now = u.copy(), u[0, 0]
    for k, asked in enumerate(u[:, 0]):
        now = asked if abs(asked - now) > 0.35 else now
        done[k, 0] = now
    assert 0 < np.count_nonzero(done != u) < 60
    x, hidden, rows = np.zeros((1, 5)), model.at_rest(1), [np.zeros(5)]
    for command in done:
        x, hidden = model.step(x, command[None], hidden)
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(len(u) + 1, 5)) * [2e-5, 2e-5, 5e-5, 1e-4, 1e-4]
    result = trace(from_arrays(model, [(y, u)]), model)
    assert result.verdict == "unexplained"
    assert "time*cmd_left" in result.depends_on


@pytest.mark.slow
def test_commands_that_are_carried_out_in_steps_are_no_limit():
    """The largest command is cut to the last step: a saturation explains that, and nothing else of it."""
    rng = np.random.default_rng(5)
    step = 0.031
    asked = _held(rng, 900, [-0.5, -1.5], [0.5, 1.5], 6)
    y = _unicycle(
        rng,
        np.column_stack([step * np.rint(asked[:, 0] / step), asked[:, 1]]),
        scheme="euler",
    )
    result = _traced(y, asked)
    assert result.verdict == "unexplained"
    assert result.depends_on[0] == "v"


@pytest.mark.slow
def test_a_push_that_swells_has_no_amplitude():
    """A sine whose amplitude grows threefold in the recording is not the library's sine, although that explains most of it."""
    rng = np.random.default_rng(6)
    u = _held(rng, 900, [-0.5, -0.8], [0.5, 0.8])
    t = DT * np.arange(900)
    swell = 0.15 * (0.4 + 1.6 * (t / t[-1]) ** 2) * np.sin(2.0 * math.pi * 0.7 * t)
    y = _unicycle(rng, u + np.column_stack([np.zeros(900), swell]), scheme="euler")
    result = _traced(y, u)
    assert result.verdict == "unexplained"
    assert {"time", "time*w"} & set(result.depends_on)


@pytest.mark.slow
def test_arcs_under_a_model_that_goes_straight_have_one_name():
    """A sideways slip of exactly half a step would say the same: that would be a coincidence, and is no tie."""
    rng = np.random.default_rng(7)
    u = _held(rng, 900, [0.2, -1.5], [0.5, 1.5])
    result = _traced(_unicycle(rng, u), u)
    assert (result.verdict, [e.name for e in result.effects]) == (
        "traced",
        ["integration_scheme"],
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_of_explanations_that_tie_the_mildest_elsewhere_is_gone_on_with(seed):
    """Its speed was always the same: a gain, a limit at that speed, a deadband. A limit would stop the robot short at any higher speed."""
    rng = np.random.default_rng(seed)
    u = np.column_stack([np.full(700, 0.25), _held(rng, 700, [-1.0], [1.0])[:, 0]])
    result = _traced(_unicycle(rng, u, lambda k, x: 0.85, "euler"), u)
    names = {(e.name, e.channel) for e in (*result.effects, *result.ambiguous_with)}
    assert result.verdict == "ambiguous"
    assert {("input_gain", "v"), ("input_saturation", "v")} <= names
    moved = result.model.step(np.zeros((1, 3)), np.array([[0.75, 0.0]]), result.model.at_rest(1))[0][0, 0]
    assert moved == pytest.approx(0.85 * 0.75 * DT, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("rests", [False, True])
def test_of_what_ties_at_one_speed_the_one_is_gone_on_with_that_is_wrong_by_least_at_lower_and_at_higher_ones(rests):
    """A deadband is the mildest at three times the speed, and the worst of all at a third of it."""
    rng = np.random.default_rng(0)
    steps = np.repeat(0.3 * rng.integers(0, 2, 30) if rests else np.full(30, 0.3), 20)
    u = np.column_stack([steps, _held(rng, 600, [-1.0], [1.0])[:, 0]])
    result = _traced(_unicycle(rng, u, lambda k, x: 0.8, "euler"), u)
    names = {(e.name, e.channel) for e in (*result.effects, *result.ambiguous_with)}
    assert {("input_gain", "v"), ("input_saturation", "v"), ("input_deadband", "v")} <= names
    assert [(e.name, e.channel) for e in result.effects] == [("input_gain", "v")]


@pytest.mark.parametrize(("push", "repaired"), [(0.001, False), (0.003, True)])
def test_what_ties_and_does_little_is_left_out_of_the_model_where_it_may_do_harm(push, repaired):
    """A push that the world gives, or that the body gives: on a robot that went one way only nobody can tell. On the way back one is worse
    than none.
    """
    rng = np.random.default_rng(0)
    u = np.column_stack([np.repeat(rng.uniform(0.1, 0.3, 30), 20), 0.05 * np.tile(np.repeat([1.0, -1.0], 20), 15)])
    x = _unicycle(rng, u, lambda k, x: 1.0, "euler")
    x[:, 1] += push * DT * np.arange(len(x))
    result = _traced(x, u)
    assert result.verdict == "ambiguous"
    assert {e.channel for e in (*result.effects, *result.ambiguous_with)} == {"world", "body"}
    assert bool(result.spec.effects) is repaired
    assert ("the model stays as it was given" in result.text()) is not repaired
    assert result.to_json()["left_as_given"] is not repaired


@pytest.mark.slow
def test_when_something_broke_is_told_by_what_was_held_out_if_it_happened_there():
    """In the stretch between 30 % and 50 % of the time, which no fit sees: there it stood in the middle, wherever it was."""
    u = _held(np.random.default_rng(20), 1000, [0.1, -1.0], [0.5, 1.0])
    y = _unicycle(np.random.default_rng(21), u, lambda k, x: 0.6 if k >= 330 else 1.0, "euler")
    result = _traced(y, u)
    assert [(e.name, e.channel) for e in result.effects] == [("regime_change", "v")]
    assert result.effects[0].parameters["time"][0] == pytest.approx(330 * DT, abs=2 * DT)
    assert result.depends_on == ()


def test_a_heading_that_nobody_steers_takes_no_name_away():
    """It wanders, by a push that nobody commands, and no model foretells it; that the wheels turn too slowly is told all the same."""
    rng = np.random.default_rng(22)
    u = np.column_stack([_held(rng, 1000, [0.2], [0.6])[:, 0], np.zeros(1000)])
    x, rows = np.array([0.0, 0.0, 0.4]), []
    for v, _ in u:
        rows.append(x)
        x = x + DT * np.array([0.8 * v * math.cos(x[2]), 0.8 * v * math.sin(x[2]), 0.0]) + [0.0, 0.0, 0.006 * rng.normal()]
    y = np.array([*rows, x]) + rng.normal(size=(1001, 3)) * NOISE * [1.0, 1.0, 0.2]
    model = compose(ModelSpec("unicycle", DT, {}, ()))
    result = trace(from_arrays(model, [(y, u)]), model, horizon=3.0)
    assert ("input_gain", "v") in {(e.name, e.channel) for e in (*result.effects, *result.ambiguous_with)}


@pytest.mark.slow
def test_two_gains_that_agree_are_one():
    """A gyro's scale that differs by sign in the fourth digit only, and long data: significant, and nothing to anybody."""
    rng = np.random.default_rng(8)
    asked = _held(rng, 4000, [-0.5, -1.0], [0.5, 1.0], 8)
    done = asked.copy()
    done[:, 1] *= np.where(asked[:, 1] > 0.0, 0.9002, 0.8998)
    x = _unicycle(np.random.default_rng(9), done, scheme="euler")
    result = _traced(x, asked)
    assert [(e.name, e.channel) for e in result.effects] == [("input_gain", "w")]


def test_explanations_that_do_the_very_same_stay_in_their_order():
    rng = np.random.default_rng(10)
    u = _held(rng, 300, [-0.5, -1.0], [0.5, 1.0])
    model = compose(ModelSpec("unicycle", DT, {}, ()))
    data = from_arrays(model, [(_unicycle(rng, u, lambda k, x: 0.8, "euler"), u)])
    given = problem(data, steps_of(data))
    gain = AppliedEffect(registry().get("effects", "input_gain"), "v", {"gain": 0.8})
    same = AppliedEffect(registry().get("effects", "input_gain_asymmetry"), "v", {"gain_positive": 0.8, "gain_negative": 0.8})
    first, second = (evaluate(given, insert(model, e, 0)) for e in (gain, same))
    found = [Scored("input_gain_asymmetry", "v", 1.0, second)]
    assert representative(given, first, found) == (first, found, False)


def test_what_is_wild_at_the_end_of_a_run_and_at_the_start_of_the_next_one_is_no_lost_command():
    """Two wild steps at the end of a run, and two at the start of the next one."""
    rng = np.random.default_rng(5)
    runs = []
    for k in range(20):
        u = _held(rng, 30, [0.2, -0.5], [0.4, 0.5])
        lost = {"first": (28, 30), "second": (0, 2)}["second" if k % 2 else "first"]
        runs.append((_unicycle(rng, u, lambda at, x, lost=lost: 0.0 if lost[0] <= at < lost[1] else 1.0, "euler"), u))
    model = compose(ModelSpec("unicycle", DT, {}, ()))
    data = from_arrays(model, runs)
    given = problem(data, steps_of(data))
    left = left_of(given, evaluate(given, model))
    assert not _staying_wild(left)
