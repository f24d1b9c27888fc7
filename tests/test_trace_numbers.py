"""Numbers that are told: unbiased where sensors are coarse against what bends with the state, and under the right law of what is left."""

from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.effects.step_effect import SensorEffect
from s2r_runtime.hookspecs import Parameter
from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data import gridding
from s2r_runtime.trace.data.dataset import Run, from_arrays, from_streams
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.estimation import discretisation_error
from s2r_runtime.trace.estimation.change_times import retimed
from s2r_runtime.trace.estimation.discretisation_error import widened
from s2r_runtime.trace.estimation.intervals import intervals
from s2r_runtime.trace.estimation.noise import Colour, no_colour, no_steadier
from s2r_runtime.trace.estimation.noise_uncertainty import doubted
from s2r_runtime.trace.estimation.order_intervals import in_either_order
from s2r_runtime.trace.estimation.parameters import Slot, bounds_of, values_of
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, insert, problem, sensitivities, told
from s2r_runtime.trace.selection.acceptance import _beyond_rounding

DRY, VISCOUS = 0.5, 0.4
WIND = 0.05


def _recorded(seed, rounded):
    """A joint that goes to and fro slowly; its speed is measured in steps of 0.3, or as badly."""
    model = compose(ModelSpec("joint", 0.02, {"mass": 1.0}))
    effects = (EffectSpec("coulomb_friction", "qd", {"force": DRY}), EffectSpec("viscous_friction", "qd", {"coefficient": VISCOUS}))
    robot = compose(ModelSpec("joint", 0.02, {"mass": 1.0}, effects))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.2, 1.2, (50, 1)), 24, axis=0)
    x, hidden, rows = np.zeros((1, 2)), robot.at_rest(1), [np.zeros(2)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(len(rows), 2)) * ([0.004, 0.06] if rounded else [0.004, 0.1])
    return model, from_arrays(model, [(np.column_stack([y[:, 0], np.round(y[:, 1] / 0.3) * 0.3 if rounded else y[:, 1]]), u)])


@pytest.mark.parametrize("rounded", [False, True])
def test_friction_is_not_told_weaker_than_it_is_because_the_speed_is_measured_coarsely(rounded):
    """Where the sensor says that the robot is, friction seems to be weaker and to grow more with the speed: by far less where it was."""
    off = []
    for seed in range(4):
        model, data = _recorded(seed, rounded)
        given = problem(data, steps_of(data))
        both = model
        for name, p in (("coulomb_friction", {"force": 0.3}), ("viscous_friction", {"coefficient": 0.3})):
            both = insert(both, AppliedEffect(registry().get("effects", name), "qd", p), len(both.effects))
        fit = fitted(given, evaluate(given, model), both)
        off.append([values_of(m, fit.free) - [DRY, VISCOUS] for m in (fit.model, told(given, fit)[0].model)])
    first, last = np.mean(np.abs(off), axis=0)
    assert np.all(np.mean(off, axis=0)[0] * [-1.0, 1.0] > 0.05)
    assert np.all(last < 0.7 * first)


def test_what_is_steadier_than_white_noise_makes_numbers_no_surer_where_process_noise_stands_at_its_floor():
    none = no_colour(2)
    law = Colour(none.coefficients + 0.1, 0.9 * none.scale, np.array([[0.0, -2.3, 0.0, 0.0], [0.0, 0.4, 0.0, 0.0]]))
    left = no_steadier(law, none, np.array([True, True]))
    assert np.all(left.slow[0] == 0.0)
    assert (left.scale[0], left.scale[1]) == (1.0, 0.9)
    assert np.all(left.coefficients[0] == 0.0)
    assert np.all(left.slow[1] == law.slow[1])
    assert np.array_equal(no_steadier(law, none, np.array([False, False])).slow, law.slow)  # a sensor that is wrong for a while


def _changed(seed, time, gain):
    """A unicycle of which w does less from one time on, among inputs that change often."""
    model = compose(ModelSpec("unicycle", 0.05))
    robot = compose(ModelSpec("unicycle", 0.05, {}, (EffectSpec("regime_change", "w", {"time": time, "gain": gain}),)))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, (100, 2)), 4, axis=0)
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    data = from_arrays(model, [(np.array(rows) + rng.normal(size=(len(rows), 3)) * 0.006, u)])
    given = problem(data, steps_of(data))
    effect = registry().get("effects", "regime_change")
    return given, evaluate(given, model), lambda when: insert(model, AppliedEffect(effect, "w", {"time": when, "gain": gain}), 0)


def test_the_time_of_a_change_leaves_a_peak_that_is_not_the_highest():
    given, nominal, changed = _changed(0, 9.33, 0.7)
    fit = fitted(given, nominal, changed(13.0))
    assert abs(fit.model.effects[0].p["time"] - 9.33) > 1.0
    assert retimed(given, fit).model.effects[0].p["time"] == pytest.approx(9.33, abs=0.1)


@pytest.mark.slow
def test_the_time_of_a_change_lies_in_its_interval_as_often_as_that_says():
    covered = 0
    for seed in range(30):
        given, nominal, changed = _changed(seed, 9.33, 0.8)
        fit = retimed(given, fitted(given, nominal, changed(9.0)))
        low, high = intervals(given, fit)[Slot(0, "time")]
        covered += low <= 9.33 <= high
    assert covered >= 26  # of 30 at 95 %: fewer in one of 80 draws


def test_a_phase_is_told_within_half_a_turn_of_zero():
    values = {"frequency": 0.9, "amplitude": 0.3, "phase": -3.09}
    model, robot = (
        compose(ModelSpec("joint", 0.04, {"mass": 1.0}, effects))
        for effects in ((), (EffectSpec("periodic_disturbance", "force", values),))
    )
    x, hidden, rows = np.zeros((1, 2)), robot.at_rest(1), [np.zeros(2)]
    for _ in range(200):
        x, hidden = robot.step(x, np.zeros((1, 1)), hidden)
        rows.append(x[0])
    y = np.array(rows) + np.random.default_rng(0).normal(size=(201, 2)) * 0.002
    data = from_arrays(model, [(y, np.zeros((200, 1)))])
    given = problem(data, steps_of(data))
    sine = AppliedEffect(registry().get("effects", "periodic_disturbance"), "force", {**values, "phase": 3.2})
    fit, _, near = told(given, fitted(given, evaluate(given, model), insert(model, sine, 0)))
    assert fit.model.effects[0].p["phase"] == pytest.approx(-3.09, abs=0.05)
    assert near.model.effects[0].p["phase"] == fit.model.effects[0].p["phase"]


def _two(effects):
    """A unicycle with two effects on w, and the model with them."""
    robot = compose(ModelSpec("unicycle", 0.05, {}, tuple(EffectSpec(name, "w", p) for name, p in effects)))
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, (100, 2)), 4, axis=0)
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    model = compose(ModelSpec("unicycle", 0.05))
    data = from_arrays(model, [(np.array(rows) + rng.normal(size=(len(rows), 3)) * 0.003, u)])
    given, both = problem(data, steps_of(data)), model
    for place, (name, p) in enumerate(effects):
        both = insert(both, AppliedEffect(registry().get("effects", name), "w", p), place)
    return given, fitted(given, evaluate(given, model), both)


def test_where_nothing_tells_which_of_two_effects_comes_first_intervals_cover_the_numbers_of_both_orders():
    given, fit = _two((("input_coupling", {"from": "v", "coefficient": -0.3}), ("input_gain", {"gain": 1.5})))
    low, high = in_either_order(given, fit)[Slot(0, "coefficient")]
    assert low < -0.45 < -0.3 < high
    assert high - low < 0.2
    low, high = in_either_order(given, fit)[Slot(1, "gain")]
    assert low < 1.5 < high < 1.52


def test_a_sine_before_a_gain_is_another_one_than_behind_it():
    given, fit = _two((("input_gain", {"gain": 1.4}), ("periodic_disturbance", {"frequency": 0.5, "amplitude": 0.2, "phase": 0.3})))
    low, high = in_either_order(given, fit)[Slot(1, "amplitude")]
    assert low < 0.2 / 1.4 < 0.2 < high


def test_where_the_order_shows_intervals_are_those_of_it():
    given, fit = _two((("input_lag", {"time_constant": 0.2}), ("input_saturation", {"low": -0.4, "high": 0.4})))
    assert in_either_order(given, fit) == intervals(given, fit)


def _blown(seed, rows=200):
    """A unicycle that the wind pushes sideways, and much less than its position is measured, anything else."""
    model = compose(ModelSpec("unicycle", 0.05))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, (rows // 4, 2)), 4, axis=0)
    x, hidden, at = np.zeros((1, 3)), model.at_rest(1), [np.zeros(3)]
    for k in range(len(u)):
        x, hidden = model.step(x, u[k : k + 1], hidden)
        x = x + [0.0, 0.05 * WIND, 0.0] + rng.normal(size=3) * [3e-4, 3e-4, 0.0]
        at.append(x[0])
    data = from_arrays(model, [(np.array(at) + rng.normal(size=(len(at), 3)) * 0.01, u)])
    given = problem(data, steps_of(data))
    wind = AppliedEffect(registry().get("effects", "constant_disturbance"), "world", {"x": 0.0, "y": WIND})
    return given, fitted(given, evaluate(given, model), insert(model, wind, 0))


def test_what_drifts_by_less_than_is_measured_does_not_make_a_number_known_that_is_not():
    """The likeliest drift is often none at all: then the whole recording were one measurement of the wind."""
    covered, sure = 0, 0
    for seed in range(40):
        given, fit = _blown(seed)
        low, high = intervals(given, fit)[Slot(0, "y")]
        covered += low <= WIND <= high
        j = sensitivities(given, fit, fit.model, fit.free)
        sure += abs(values_of(fit.model, fit.free)[1] - WIND) < 1.96 * np.sqrt(np.linalg.inv(j.T @ j)[1, 1])
    assert sure <= 33  # what the likelihood alone would say
    assert covered >= 36  # of 40 at 95 %: fewer in one of 60 draws


def test_drift_that_is_well_known_makes_intervals_no_wider():
    given, fit = _blown(0, 3000)
    noisier = replace(given, steps=replace(given.steps, y1=given.steps.y1 + np.random.default_rng(1).normal(size=(3000, 3)) * 0.05))
    assert np.all(doubted(noisier, evaluate(noisier, fit.model)) < 1.02)


def test_a_slip_is_known_no_better_than_whether_the_robot_moves_on_arcs():
    model = compose(ModelSpec("unicycle", 0.05))
    effects = (
        EffectSpec("integration_scheme", "*", {"scheme": "exact"}),
        EffectSpec("lateral_slip", "*", {"coefficient": 0.1}),
    )
    robot = compose(ModelSpec("unicycle", 0.05, {}, effects))
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, (100, 2)), 4, axis=0)
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    data = from_arrays(model, [(np.array(rows) + rng.normal(size=(len(rows), 3)) * 0.003, u)])
    given = problem(data, steps_of(data))
    slip = AppliedEffect(registry().get("effects", "lateral_slip"), "*", {"coefficient": 0.1})
    fit = fitted(given, evaluate(given, model), insert(model, slip, 0))
    slot = Slot(0, "coefficient")
    low, high = intervals(given, fit)[slot]
    assert low > 0.1  # half a step more, by a model that moves in straight pieces
    low, high = in_either_order(given, fit)[slot]
    assert low < 0.1
    assert 0.125 < high < 0.14


def _within_steps(**effects):
    """A joint with effects on its force, whose commands come on a clock of their own: the problem, and a fit from the true numbers."""
    model, finely = (compose(ModelSpec("joint", dt, {"mass": 1.0})) for dt in (0.1, 0.002))
    for place, (name, p) in enumerate(effects.items()):
        model, finely = (insert(m, AppliedEffect(registry().get("effects", name), "force", p), place) for m in (model, finely))
    rng = np.random.default_rng(0)
    changes = np.cumsum(rng.integers(60, 140, 180))
    held = rng.uniform(-1.0, 1.0, len(changes))
    u = np.concatenate([[0.0], held])[np.searchsorted(changes, np.arange(20000), side="right")]
    x, hidden, rows = np.zeros((1, 2)), finely.at_rest(1), [np.zeros(2)]
    for k in range(len(u)):
        x, hidden = finely.step(x, u[k : k + 1, None], hidden)
        rows.append(x[0])
    y = np.array(rows[::50]) + rng.normal(size=(401, 2)) * 1e-4
    data = from_streams(replace(model, effects=()), [(Stream(0.1 * np.arange(401), y), Stream(0.002 * changes, held[:, None]))], "rows")
    given = problem(data, steps_of(data))
    return given, fitted(given, evaluate(given, model), model)


@pytest.mark.slow
def test_a_lag_is_told_right_where_commands_come_within_steps():
    """On a clock of their own: a change that counts as a mean over a quarter of a step looks like more delay and less lag."""
    _, fit = _within_steps(input_delay={"delay": 0.094}, input_lag={"time_constant": 0.112})
    delay, lag = values_of(fit.model, (Slot(0, "delay"), Slot(1, "time_constant")))
    assert delay == pytest.approx(0.094, abs=5e-4)
    assert lag == pytest.approx(0.112, abs=5e-4)


def test_a_rate_is_told_right_where_commands_come_within_steps():
    """A mean of before and after, taken for a command, would be followed before it came: the rate looked low by a hundredth."""
    given, fit = _within_steps(input_rate_limit={"rate": 9.0})
    (low, high) = intervals(given, fit)[Slot(0, "rate")]
    assert low < 9.0 < high < low + 0.01


def test_an_interval_takes_up_what_is_not_known_of_when_within_a_step_a_command_came():
    """What a limit cuts off of a mean of before and after is less than what it cuts off of both: it looks low."""
    given, fit = _within_steps(input_saturation={"low": -0.5, "high": 0.5})
    found = intervals(given, fit)
    low, high = found[Slot(0, "high")]
    assert high < 0.5
    wider = widened(given, fit, dict(found))[Slot(0, "high")]
    assert wider[0] == low
    assert 0.5 < wider[1] < 0.5 + 3.0 * (0.5 - low)


def test_what_a_grid_adds_stays_within_what_a_number_may_be(monkeypatch):
    given, fit = _two((("input_lag", {"time_constant": 0.2}), ("input_gain", {"gain": 0.7})))
    found = intervals(given, fit)
    monkeypatch.setattr(discretisation_error, "_shifts", lambda given, fit: [np.array([-1.0, 1e9])])
    lag, gain = (widened(given, fit, dict(found))[slot] for slot in fit.free)
    assert lag == (bounds_of(fit.model, fit.free[0]).low, found[fit.free[0]][1])
    assert gain == (found[fit.free[1]][0], bounds_of(fit.model, fit.free[1]).high)


@pytest.mark.parametrize(
    ("offset", "step", "speeds", "believed"),
    [(-0.03, 0.24, 5, False), (-0.2, 0.24, 5, True), (-0.03, 0.0, 5, True), (-0.06, 0.24, 300, True), (-0.01, 0.24, 300, False)],
)
def test_an_offset_of_a_sensor_that_its_rounding_may_be_is_none(offset, step, speeds, believed):
    """One value in steps of 0.24 m/s is off by up to 0.12 m/s; the mean of many different ones is known better."""
    given, model = _coarse_speed(step, speeds)
    offsets = AppliedEffect(registry().get("effects", "sensor_offset"), "speed", {"offset": offset})
    base, fit = (evaluate(given, m) for m in (model, insert(model, offsets, 0)))
    assert _beyond_rounding(given, fit, base) == believed
    assert _beyond_rounding(given, fit, fit)  # what was there before is not asked again


class _Scale(SensorEffect):
    """measured = gain * true"""

    name = "sensor_scale"
    parameters = (Parameter("gain", "", 0.5, 2.0, neutral=1.0),)

    def to_true(self, x, model, channel, p):
        return self.to_measured(x, model, channel, {"gain": 1.0 / p["gain"]})

    def to_measured(self, x, model, channel, p):
        after = x.copy()
        after[:, model.states.index(channel)] *= p["gain"]
        return after


def test_a_sensor_that_reads_too_much_is_not_asked_whether_its_factor_is_below_its_step():
    given, model = _coarse_speed(3.0, 5)
    scaled = insert(model, AppliedEffect(_Scale(), "speed", {"gain": 1.2}), 0)
    assert _beyond_rounding(given, evaluate(given, scaled), evaluate(given, model))


def _coarse_speed(step, speeds):
    """A car that reads its speed in such steps, m/s (0: as it is), and has had so many; its model."""
    model = compose(ModelSpec("bicycle", 0.04, {"wheel_base": 0.48}))
    speed = np.tile(np.linspace(0.1, max(step, 0.24) * min(speeds, 60), speeds), 600 // speeds)
    rough = speed + np.random.default_rng(0).normal(size=len(speed)) * 1e-3
    y = np.column_stack([0.04 * np.cumsum(speed), 0.0 * speed, 0.0 * speed, np.round(speed / step) * step if step else rough])
    data = from_arrays(model, [(y, np.column_stack([0.0 * speed, speed])[:-1])])
    return problem(data, steps_of(data)), model


def test_what_changes_within_a_coarse_part_is_over_by_its_end_only_if_the_next_one_holds():
    u = np.array([[0.0, 0.0, 0.0, 1.0], [1.0, 1.0, 1.0, 2.0], [2.0, 3.0, 3.0, 3.0]]).reshape(-1, 1)
    pairs = gridding._joined(Run(0.0, np.zeros((4, 1)), u), 4, 2)
    assert pairs.turned[:, 0].tolist() == [True, False, False]
    fine = Run(0.0, np.zeros((4, 1)), u, turned=np.array([[False], [True], [False]]))
    assert gridding._joined(fine, 4, 2).turned[:, 0].tolist() == [True, False, False]
    assert pairs.u[:, 0].tolist() == [0.0, 0.5, 1.0, 1.5, 2.5, 3.0]
