"""Where there is nothing to name, or nothing that the library knows, or no way to tell, the tracer says so."""

import math
from dataclasses import replace

import numpy as np
import pytest
from seeds import first
from trace_robots import DT, NOISE, ROBOTARIUM, commands, declared, drive, recordings, wandering

from s2r_runtime.errors import ConfigError, NotEnoughEvidence, RecordingError
from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.report.trace_page import trace_page
from s2r_runtime.trace import verdict
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics import lack_of_fit as lack_of_fit_of
from s2r_runtime.trace.diagnostics.lack_of_fit import Looks, Structure, _weight_of, left_of
from s2r_runtime.trace.diagnostics.rollout_error import held, judge, noise_floor
from s2r_runtime.trace.diagnostics.whole_recording import Whole
from s2r_runtime.trace.estimation.noise import MEMORIES
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, gain, insert, problem
from s2r_runtime.trace.hypotheses.dependence import about_states
from s2r_runtime.trace.hypotheses.random_fields import Field
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection.acceptance import significant
from s2r_runtime.trace.selection.basis_evidence import BLOCKS, Judged
from s2r_runtime.trace.sensor_faults.detect import Checked
from s2r_runtime.trace.verdict import foretells, misses

STEPS = 700
GAIN = [("input_gain", "w", {"gain": 0.75})]


def _names(found):
    return {(e.name, e.channel) for e in found}


@pytest.mark.parametrize("inputs", [commands, wandering])
def test_clean_data_give_no_alarm(inputs):
    assert [trace(data, declared()).verdict for data in recordings([], 4, steps=STEPS, seed=11, inputs=inputs)] == ["none"] * 4


@pytest.mark.slow
def test_heavy_tails_are_no_effect_and_no_fault():
    rng = np.random.default_rng(5)
    for data in recordings([], 2, steps=STEPS, seed=12, noise=0.0 * NOISE):
        y = data.runs[0].y
        y += rng.standard_t(3, size=y.shape) * NOISE
        found = trace(data, declared())
        assert found.verdict == "none"


def test_wandering_yaw_noise_gets_no_name():
    """An autoregressive disturbance of the yaw rate, 0.05 rad/s, remembered for ten steps."""
    rng = np.random.default_rng(100)
    push = np.zeros((4, 1))

    def wander(x, v, w):
        keep = 0.9**0.1  # ten parts a step
        push[:, 0] = keep * push[:, 0] + 0.05 * math.sqrt(1 - keep * keep) * rng.normal(size=4)
        return v, w + push[:, 0], 0.0, 0.0

    assert [trace(data, declared()).verdict for data in recordings([], 4, steps=STEPS, seed=200, outside=wander)] == ["none"] * 4


@pytest.mark.slow
@pytest.mark.parametrize("which", first(1, range(3)))
@pytest.mark.parametrize(
    ("effects", "outside", "depends_on"),
    [
        ([("wavy", "w", {"height": 0.3})], None, "w"),
        ([], lambda x, v, w: (v * (1 + 0.3 * np.cos(x[:, 2])), w * (1 + 0.3 * np.cos(x[:, 2])), 0.0, 0.0), "heading"),
        ([], lambda x, v, w: (v * (1.0 + 0.4 * np.sin(25.0 * x[:, 0])), w, 0.0, 0.0), "position"),
    ],
    ids=["wavy response", "gain that depends on the heading", "stripes that slip"],
)
def test_an_effect_outside_the_library_gets_no_name_but_what_it_depends_on(effects, outside, depends_on, which):
    found = trace(recordings(effects, 3, steps=1200, seed=21, outside=outside)[which], declared())
    assert found.verdict == "unexplained"
    assert not found.effects
    assert depends_on in found.depends_on
    assert found.spec == declared().spec


def test_effects_that_the_data_cannot_tell_apart_are_listed_together_with_what_would():
    """The robot only ever gets w = 0 or 1: a gain and a limit do the same."""
    rng = np.random.default_rng(4)
    u = np.zeros((1, 700, 2))
    u[0, :, 0] = 0.1
    u[0, 3:, 1] = 1.0
    y = drive(rng, "unicycle", u, (*ROBOTARIUM, ("input_gain", "w", {"gain": 0.8})), DT, NOISE)
    found = trace(from_arrays(declared(), [(y[0], u[0])]), declared())
    assert found.verdict == "ambiguous"
    assert {("input_gain", "w"), ("input_saturation", "w")} <= _names(found.effects) | _names(found.ambiguous_with)
    assert "w" in found.suggested_excitation
    assert found.any_shape_of == ("w",)
    assert found.depends_on[0] == "w"
    assert "or          any unnamed effect that depends on w" in found.text()
    assert "remaining   none above noise" in found.text()
    assert "What is left" not in trace_page(found)


def test_a_sensor_that_jumps_is_a_fault_and_not_an_effect():
    data = recordings([], 1, steps=STEPS, seed=31)[0]
    data.runs[0].y[300:, 0] += 0.08
    found = trace(data, declared())
    assert found.verdict == "sensor_fault"
    (fault,) = found.to_json()["faults"]
    assert (fault["kind"], fault["channel"]) == ("offset_jump", "x")
    assert fault["from_s"] == pytest.approx(300 * DT)


def test_an_effect_is_found_beside_a_fault():
    data = recordings(GAIN, 1, steps=STEPS, seed=32)[0]
    data.runs[0].y[200, 1] += 0.3
    found = trace(data, declared())
    assert found.verdict == "traced"
    assert _names(found.effects) == {("input_gain", "w")}
    assert [f.kind for f in found.faults] == ["spike"]


def _driven(steps=STEPS, seed=41):
    return recordings([], 1, steps=steps, seed=seed)[0].runs[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "spoil",
    [
        lambda y, u: (y, u[:, ::-1].copy()),
        lambda y, u: (y[:, [1, 0, 2]].copy(), u),
        lambda y, u: (np.column_stack([y[:, :2], np.degrees(y[:, 2])]), u),
    ],
    ids=["inputs swapped", "axes swapped", "degrees"],
)
def test_columns_that_are_not_what_they_say_get_no_effect_for_an_explanation(spoil):
    run = _driven(1200)
    y, u = spoil(run.y, run.u[::5])
    found = trace(from_arrays(declared(), [(y, u)]), declared())
    assert found.verdict == "unexplained"
    assert found.effects == ()


@pytest.mark.parametrize(("beyond", "said"), [(0.0, False), (0.06, True)])
def test_digits_that_rounding_cuts_off_are_no_structure_and_more_than_these_is(beyond, said):
    """Wheels that turn as commanded and are told in coarse steps: what is cut off goes with the command. beyond: rad/s that one of them
    turns faster or slower than commanded.
    """
    rng = np.random.default_rng(44)
    u = np.clip(2.0 * np.sin(0.05 * np.arange(500)[:, None] + [0.0, 1.0]), -1.04, 1.04)  # as fast as it may, and what is between
    turned = np.vstack([np.zeros(2), u + beyond * np.sign(np.sin(9.0 * u[:, :1])) * [1.0, 0.0]])
    model = compose(ModelSpec("differential_drive", 0.1, {"wheel_radius": 0.1, "track": 0.5}))
    y = np.column_stack([rng.normal(size=(501, 3)), 0.1 * np.rint((turned + 1e-4 * rng.normal(size=(501, 2))) / 0.1)])
    data = from_arrays(model, [(y, u)])
    given = problem(data, steps_of(data))
    fit = evaluate(given, model)
    left = left_of(given, fit)
    x = np.zeros((500, 5, 1))
    x[:, 3, 0] = left.r[:, 3]
    told = Judged("cmd_left", x, 100.0, 1.0, np.ones((BLOCKS, 1)))
    assert _weight_of(left, fit, told, 10)[0] == said


def test_what_one_step_alone_says_is_no_effect():
    """The wheels are where the command was before its largest change, in the one row that was stamped at that very moment."""
    rng = np.random.default_rng(45)
    u = np.repeat(rng.uniform(-3.0, 3.0, (20, 2)), 12, axis=0)
    u[120:132, 0], u[132:144, 0] = -4.0, 4.0
    model = compose(ModelSpec("differential_drive", 0.02, {"wheel_radius": 0.1, "track": 0.5}))
    x = np.zeros((241, 5))
    for k, asked in enumerate(u):
        x[k + 1] = model.step(x[k : k + 1], asked[None, :], model.at_rest(1))[0][0]
    y = x + rng.normal(size=x.shape) * [1e-3, 1e-3, 1e-3, 0.01, 0.01]
    y[133, 3] = y[132, 3]
    given = problem(from_arrays(model, [(y, u)]), steps_of(from_arrays(model, [(y, u)])))
    base = evaluate(given, model)
    limit = AppliedEffect(registry().get("effects", "input_rate_limit"), "cmd_left", {"rate": 300.0})
    fit = fitted(given, base, insert(model, limit, 0))
    assert gain(fit, base) > 100.0
    assert not significant(given, fit, base, 100)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_robot_that_stood_still_although_it_was_asked_to_move_shows_nothing(noise):
    run = _driven()
    y = np.repeat(run.y[:1], len(run.y), axis=0) + noise * NOISE * np.random.default_rng(2).normal(size=run.y.shape)
    with pytest.raises(NotEnoughEvidence, match="stood still although it was asked to move"):
        trace(from_arrays(declared(), [(y, run.u[::5])]), declared())


def test_a_slow_robot_under_a_loud_sensor_is_traced():
    """In a second it goes no farther than its position jumps from row to row; in half a minute it does."""
    nominal = compose(ModelSpec("unicycle", 0.1))
    u = np.tile([0.3, 0.05], (900, 1))
    x, rows = np.zeros((1, 3)), [np.zeros(3)]
    for k in range(len(u)):
        x = nominal.nominal.step(x, u[k : k + 1], 0.1, {})
        rows.append(x[0])
    noisy = np.array(rows) + np.random.default_rng(0).normal(size=(901, 3)) * [0.5, 0.5, 0.3]
    assert trace(from_arrays(nominal, [(noisy, u)]), nominal).verdict == "none"


def test_a_sensor_that_froze_halfway_is_a_fault():
    data = recordings([], 1, steps=STEPS, seed=42)[0]
    data.runs[0].y[STEPS // 2 :] = data.runs[0].y[STEPS // 2]
    found = trace(data, declared())
    assert found.verdict == "sensor_fault"
    assert "frozen" in {f.kind for f in found.faults}


def test_a_heading_sensor_that_jumped_for_good_is_a_fault():
    data = recordings([], 1, steps=STEPS, seed=43)[0]
    data.runs[0].y[STEPS // 2 :, 2] += 0.7
    assert trace(data, declared()).verdict == "sensor_fault"


def _pushed(times, rng):
    """A slow drive with hard pushes, at half the speed each."""
    u = commands(rng, 1, STEPS, DT, [(0.02, 0.06), (-0.5, 0.5)], rest=0.0)
    went = u.copy()
    for k in times:
        u[0, k : k + 20, 0], went[0, k : k + 20, 0] = 0.19, 0.1
    return from_arrays(declared(), [(drive(rng, "unicycle", went, ROBOTARIUM, DT, NOISE)[0], u[0])])


def test_one_push_that_did_less_is_no_end_stop():
    """Somebody may have held it."""
    found = trace(_pushed([90], np.random.default_rng(1)), declared())
    assert (found.verdict, found.effects) == ("unexplained", ())


@pytest.mark.slow
def test_what_only_the_fit_has_seen_is_said_to_be_unconfirmed():
    """What it is judged on asks for nothing of the kind."""
    rng = np.random.default_rng(1)
    found = trace(_pushed([90, 300, 500], rng), declared(), test=_pushed([], rng))
    assert [(e.name, e.channel) for e in found.effects] == [("input_saturation", "v")]
    assert found.to_json()["unconfirmed"] == [{"name": "input_saturation", "channel": "v"}]
    assert "not confirmed: input_saturation on v" in " ".join(found.text().split())
    for data in recordings(GAIN, 1, steps=STEPS, seed=45):
        assert trace(data, declared()).unconfirmed == ()


@pytest.mark.parametrize(("pushes", "once"), [([280], True), ([300], True), ([100, 500], False), ([0], True), ([580], True)])
def test_what_is_done_at_one_time_only_may_lie_anywhere(pushes, once):
    """Also across the edge of two parts of the time. A cart that is pushed now and then does half of what it is asked."""
    u = np.zeros((600, 1))
    for k in pushes:
        u[k : k + 20] = 1.0
    model = compose(ModelSpec("joint", DT, {}, ()))
    data = from_arrays(model, [(np.zeros((601, 2)), u)])
    weak = insert(model, AppliedEffect(registry().get("effects", "input_gain"), "force", {"gain": 0.5}), 0)
    assert verdict._once(problem(data, steps_of(data)), weak, model) == once


def test_what_is_done_at_two_times_is_not_done_at_one_because_nothing_between_them_was_fitted():
    """What was held out lies between them, or the end of a run."""

    def pushed(*begins):
        u = np.zeros((600, 1))
        for k in begins:
            u[k : k + 15] = 1.0
        return u

    model = compose(ModelSpec("joint", DT, {}, ()))
    weak = insert(model, AppliedEffect(registry().get("effects", "input_gain"), "force", {"gain": 0.5}), 0)
    one = from_arrays(model, [(np.zeros((601, 2)), pushed(165, 300))])
    steps = steps_of(one)
    seen = (steps.place < 180) | ((steps.place >= 300) & (steps.place < 480))
    assert not verdict._once(problem(one, steps.take(seen)), weak, model)
    sparse = steps.take(steps.place % 10 == 0)  # as of a long recording, of which a part is fitted
    long = from_arrays(model, [(np.zeros((601, 2)), pushed(280, 295, 310))])
    assert verdict._once(problem(long, sparse), weak, model)
    two = from_arrays(model, [(np.zeros((601, 2)), pushed(585)), (np.zeros((601, 2)), pushed(0))])
    assert not verdict._once(problem(two, steps_of(two)), weak, model)


@pytest.mark.slow
def test_what_was_met_at_one_time_only_and_is_not_asked_for_elsewhere_gets_no_name(monkeypatch):
    """Numbers that were fitted without it foretell a little better or worse by chance, which confirms nothing."""
    data = recordings(GAIN, 1, steps=STEPS, seed=45)[0]
    assert trace(data, declared()).effects
    monkeypatch.setattr(verdict, "asked", lambda *of: False)
    assert trace(data, declared()).effects
    monkeypatch.setattr(verdict, "_once", lambda *of: True)
    assert trace(data, declared()).effects == ()


@pytest.mark.slow
def test_measurements_without_noise_are_no_effect():
    for data in recordings([], 3, steps=STEPS, seed=44, noise=0.0 * NOISE):
        assert trace(data, declared()).verdict == "none"


def test_a_model_whose_rollouts_end_nowhere_near_is_another_robots_and_not_one_to_which_nothing_is_missing():
    """A hovercraft, whose commands are accelerations. Noise that takes rollouts as far is no other robot."""
    run = _driven()
    u = run.u[::5]
    speed = DT * np.cumsum(u, axis=0)
    theta = DT * np.cumsum(np.append(0.0, speed[:-1, 1]))
    steps = DT * speed[:, :1] * np.column_stack([np.cos(theta), np.sin(theta)])
    hovering = np.column_stack([np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)]), np.append(theta, theta[-1])])
    for y, nothing in ((hovering, True), (run.y, False)):
        data = from_arrays(declared(), [(y, u)])
        given = held(declared(), data, steps_of(data), (), np.ones(len(u), dtype=bool), 1.0)
        judged = judge(declared(), given)
        assert misses(judged, given, NOISE) == nothing
        assert not misses(judged, given, 100.0 + NOISE)


@pytest.mark.parametrize(("strong", "missing"), [(0.25, False), (1.5, True)])
def test_something_is_missing_where_most_of_the_way_is_although_it_looks_like_noise_that_wanders(strong, missing):
    """A wind from changing sides, strong over the speed, whatever is asked."""
    rng = np.random.default_rng(4)
    ways = np.repeat(rng.uniform(-math.pi, math.pi, 40), 25)
    u = np.column_stack([np.full(1000, 0.2), rng.normal(size=1000)])
    theta = DT * np.cumsum(np.append(0.0, u[:, 1]))
    push = DT * 0.2 * strong * np.column_stack([np.cos(ways), np.sin(ways)])
    steps = DT * 0.2 * np.column_stack([np.cos(theta[:-1]), np.sin(theta[:-1])]) + push
    y = np.column_stack([np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)]), theta]) + NOISE * rng.normal(size=(1001, 3))
    model = compose(ModelSpec("unicycle", DT))
    data = from_arrays(model, [(y, u)])
    given = held(model, data, steps_of(data), (), np.ones(1000, dtype=bool), 1.0)
    assert misses(judge(model, given), given, NOISE) == missing


def test_what_only_sliding_shows_gives_way_to_a_field_that_explains_more(monkeypatch):
    """Sliding names what it tries. Here a yaw push that nobody named is left."""
    (data,) = recordings([], 1, steps=STEPS, seed=46)
    given = problem(data, steps_of(data))
    nominal = evaluate(given, declared())
    push = np.zeros((len(given.steps), 3, 1))
    push[:, 2, 0] = 0.02
    bias = AppliedEffect(registry().get("effects", "input_bias"), "w", {"bias": 0.02 / DT})
    named = insert(declared(), bias, 0)
    looks = Looks(left_of(given, evaluate(given, named)))
    there = Field("time", (), push, np.array([-1.0]), 500.0, lambda: 400.0)
    slid = Judged("memory(w)", push, 0.0, 1.0, np.full((BLOCKS, 1), -0.5))
    monkeypatch.setattr(Looks, "field", there)
    monkeypatch.setattr(lack_of_fit_of, "_forward", lambda of: ([slid], {"memory(w)": 0.0}))
    monkeypatch.setattr(lack_of_fit_of, "_for_a_while", lambda left: None)
    monkeypatch.setattr(lack_of_fit_of, "_wanders", lambda left, judged, enough: False)
    for nats, tokens in ((0.0, ("time",)), (600.0, ("memory(w)",))):
        monkeypatch.setattr(lack_of_fit_of, "nats_of", lambda left, judged, nats=nats: nats)
        assert lack_of_fit_of.lack_of_fit(looks, nominal, 30).tokens == tokens


@pytest.mark.parametrize(("ahead", "by_noise", "foretold"), [(0.2, True, True), (0.2, False, False), (-0.2, True, False)])
def test_a_robot_that_noise_pushes_about_is_foretold_as_far_as_noise_lets_it(ahead, by_noise, foretold):
    """After five seconds noise has taken it three quarters as far as it drove; a model that drives the other way foretells nothing."""
    rng = np.random.default_rng(6)
    n, horizon, push = 2000, 50, 0.106
    y = np.zeros((n + 1, 3))
    y[1:, :2] = np.cumsum(DT * np.array([0.2, 0.0]) + push * rng.normal(size=(n, 2)), axis=0)
    model = compose(ModelSpec("unicycle", DT))
    data = from_arrays(model, [(y, np.tile([ahead, 0.0], (n, 1)))])
    given = held(model, data, steps_of(data), (), np.ones(n, dtype=bool), horizon * DT)
    floor = push * math.sqrt(horizon) * np.array([1.0, 1.0, 0.0]) * (1.0 if by_noise else 0.1)
    assert foretells(judge(model, given), given, floor) == foretold


@pytest.mark.parametrize(
    ("off", "beyond", "foretold"),
    [((0.94, 0.94), (False, False), True), ((0.94, 0.94), (False, True), False), ((0.6, 0.94), (False, True), True)],
)
def test_a_state_that_noise_takes_far_does_not_speak_for_one_that_it_does_not(monkeypatch, off, beyond, foretold):
    """off: shares of the way that two states end off by; beyond: whether noise alone falls short of that."""
    (data,) = recordings([], 1, steps=STEPS, seed=46)
    given = held(declared(), data, steps_of(data), (), np.ones(STEPS, dtype=bool), 1.0)
    monkeypatch.setattr(verdict, "_off", lambda judged, given: (np.array(off), np.array([True, True])))
    monkeypatch.setattr(verdict, "_beyond_noise", lambda judged, given, floor: np.array(beyond))
    assert foretells(judge(declared(), given), given, NOISE) == foretold


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_heading_that_is_pushed_about_takes_no_name_from_wheels_that_go_as_they_are_told(seed):
    """In a second, pushes that nobody commands turn the robot farther than its wheels do, and it is seen too coarsely to go anywhere."""
    rng = np.random.default_rng([47, seed])
    n, dt, most = 700, 0.02, 4.0
    model = compose(ModelSpec("differential_drive", dt, {"wheel_radius": 0.05, "track": 0.5}))
    asked = np.repeat(rng.uniform(-8.0, 8.0, size=(n // 20, 2)), 20, axis=0)
    wheels = np.column_stack([np.clip(asked[:, 0], -most, most), asked[:, 1]])
    x = np.zeros((n + 1, 5))
    for k in range(n):
        x[k + 1] = model.advance(x[k : k + 1], wheels[k : k + 1], wheels[k : k + 1])[0]
        x[k + 1, 2] += 0.15 * rng.normal()
    y = x + rng.normal(size=x.shape) * np.array([0.1, 0.1, 0.05, 0.2, 0.2])
    found = trace(from_arrays(model, [(y, asked)]), model)
    assert found.verdict == "traced", found.depends_on
    assert _names(found.effects) == {("input_saturation", "cmd_left")}


def test_a_model_that_nothing_can_ask_to_move_is_refused_in_a_line(tmp_path):
    path = tmp_path / "own.py"
    path.write_text('STATES, INPUTS, PARAMS = ("q",), (), {}\n\n\ndef step(x, u, dt, params):\n    return x - dt * x\n')
    with pytest.raises(ConfigError, match="INPUTS is empty"):
        compose(ModelSpec(str(path), 0.1))
    joint = compose(ModelSpec("joint", 0.1))
    model = replace(joint, nominal=replace(joint.nominal, inputs=()))  # as a plug-in may offer one
    y = np.random.default_rng(0).normal(size=(301, 2)) * 1e-3
    with pytest.raises(NotEnoughEvidence, match="the model has no inputs"):
        trace(from_arrays(model, [(y, np.zeros((300, 0)))]), model)


def test_noise_remembers_no_longer_than_a_run_was_measured_whatever_was_commanded_before():
    rng, model = np.random.default_rng(4), compose(ModelSpec("joint", 0.02))
    y, u = np.cumsum(rng.normal(size=(121, 2)) * 0.01, axis=0), np.zeros((120, 1))
    floors = []
    for early in (0, 300):
        nowhere, nothing = np.full((early, 2), np.nan), np.zeros((early, 1))
        data = from_arrays(model, [(np.concatenate([nowhere, y]), np.concatenate([nothing, u]))])
        steps = steps_of(data)
        given = held(model, data, steps, (), np.ones(early + 120, dtype=bool), 0.2)
        fit = evaluate(problem(data, steps), model)
        slow = np.zeros((2, len(MEMORIES)))
        slow[:, -1] = 0.8
        floors.append(noise_floor(replace(fit, colour=replace(fit.colour, slow=slow)), given, 0)[1])
    assert floors[1] == pytest.approx(floors[0], rel=1e-9)


@pytest.mark.parametrize(("left", "bent"), [({"position": 0.2}, True), ({"position": 0.01}, False), ({"speed": 0.2}, False)])
def test_what_goes_with_the_position_beside_a_spring_says_that_it_is_none(left, bent):
    """left: nats of what is left, as a share of what the spring explains."""
    rng, model = np.random.default_rng(17), compose(ModelSpec("joint", 0.02, {"mass": 0.8}))
    u = np.repeat(rng.uniform(-4.0, 4.0, (50, 1)), 10, axis=0)
    x, rows = np.zeros(2), [np.zeros(2)]
    for push in np.repeat(u[:, 0], 10):
        x = x + 0.002 * np.array([x[1], (push - 5.0 * x[0] ** 3 - 0.3 * x[1]) / 0.8])
        rows.append(x)
    data = from_arrays(model, [(np.array(rows[::10]) + rng.normal(size=(501, 2)) * [1e-4, 2e-3], u)])
    given = problem(data, steps_of(data))
    nominal = evaluate(given, model)
    spring = AppliedEffect(registry().get("effects", "cubic_stiffness"), "q", {"coefficient": 3.0})
    named = fitted(given, nominal, insert(model, spring, 0))
    nats = {token: share * gain(named, nominal) for token, share in left.items()}
    assert gain(named, nominal) > 50.0
    whole = Whole(Checked(data, (), (), 0), model, 10)
    assert whole._bent(Structure(tuple(nats), True, 0.03, nats), named) is bent
    assert not whole._bent(Structure((), True, 0.03, {}), nominal), "what explains nothing is bent by nothing"


@pytest.mark.parametrize(
    ("effect", "channel", "p", "token"),
    [
        ("cubic_stiffness", "q", {"coefficient": 3.0}, {"position"}),
        ("viscous_friction", "qd", {"coefficient": 0.3}, {"speed"}),
        ("quadratic_drag", "qd", {"coefficient": 0.3}, {"speed"}),
        ("sensor_offset", "qd", {"offset": 0.1}, set()),
        ("input_gain", "force", {"gain": 1.2}, set()),
    ],
)
def test_what_goes_with_a_speed_or_a_position_does_so_whatever_it_is_called(effect, channel, p, token):
    model = insert(compose(ModelSpec("joint", 0.02)), AppliedEffect(registry().get("effects", effect), channel, p), 0)
    data = from_arrays(model, [(np.random.default_rng(1).normal(size=(20, 2)), np.zeros((19, 1)))])
    assert about_states(model, (0,), data, steps_of(data)) == token


@pytest.mark.parametrize(
    ("spoil", "error", "said"),
    [
        (lambda y, u: (np.full_like(y, np.nan), u), NotEnoughEvidence, "0 usable transitions"),
        (lambda y, u: (y[:1], u[:0]), NotEnoughEvidence, "0 usable transitions"),
        (lambda y, u: (y, np.where(np.arange(len(u))[:, None] == 5, np.nan, u)), RecordingError, "row 5: v is nan, must be finite"),
        (lambda y, u: (y, u * 1e200), RecordingError, "must be finite, within 1e+30"),
        (lambda y, u: (y * 1e150, u), RecordingError, r"must be finite or NaN \(not measured\)"),
        (lambda y, u: (y[:, :2], u), RecordingError, r"states \(701, 2\) and inputs \(700, 2\), must be \(K \+ 1, 3\) and \(K, 2\)"),
        (lambda y, u: (y[:-1], u), RecordingError, r"must be \(K \+ 1, 3\) and \(K, 2\)"),
    ],
)
def test_arrays_that_are_no_recording_are_refused_in_a_line(spoil, error, said):
    rng = np.random.default_rng(4)
    u = rng.uniform(-0.2, 0.2, (700, 2))
    y = drive(rng, "unicycle", u[None], ROBOTARIUM, DT, NOISE)[0]
    with pytest.raises(error, match=said.replace("1e+", r"1e\+")):
        trace(from_arrays(declared(), [spoil(y, u)]), declared())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_way_that_is_none_of_the_commands_gets_no_name(seed):
    """A random walk: what silences every input leaves noise, step by step, and a robot that goes by itself. No limit does that."""
    rng = np.random.default_rng([71, seed])
    u = commands(rng, 1, 700, DT, [(-0.2, 0.2), (-1.0, 1.0)])[0]
    walk = np.cumsum(rng.normal(size=(701, 3)) * [0.01, 0.01, 0.03], axis=0)
    model = compose(ModelSpec("unicycle", DT, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    found = trace(from_arrays(model, [(walk, u)]), model)
    assert (found.verdict, found.effects) == ("unexplained", ())
