"""Rows that are off by no more than the model as given allows: a joint's encoder among its speeds, a heading that jumps behind a lag."""

from dataclasses import replace

import numpy as np
import pytest
from seeds import first

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import Dataset, Stream, from_arrays, from_streams
from s2r_runtime.trace.estimation.prediction import rms
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.sensor_faults.detect import check

DT_S, ROWS, FAST = 0.01, 3000, 1154
FRICTION = (EffectSpec("coulomb_friction", "qd", {"force": 1.5}), EffectSpec("viscous_friction", "qd", {"coefficient": 1.2}))
JOINT = compose(ModelSpec("joint", DT_S, {"mass": 2.0}))
CART = compose(ModelSpec("unicycle", 0.05))


def _joint(off: float) -> Dataset:
    """A joint that sweeps to and fro at up to 4 m/s, read to 20 um, with one sample of its position off while it is fast."""
    robot = compose(ModelSpec("joint", DT_S, {"mass": 2.0}, FRICTION))
    rng, t = np.random.default_rng(3), DT_S * np.arange(ROWS)
    u = (40.0 * np.sin(2.0 * np.pi * 1.3 * t) + 15.0 * np.sin(2.0 * np.pi * 3.1 * t + 1.0))[:, None]
    x, hidden, rows = np.zeros((1, 2)), robot.at_rest(1), [np.zeros(2)]
    for k in range(ROWS):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(ROWS + 1, 2)) * [2e-5, 2e-3]
    y[FAST, 0] += off
    return from_arrays(JOINT, [(y, u)])


@pytest.mark.parametrize("off", first(2, [0.05, -0.02, -0.05, 0.02]))
def test_one_bad_sample_hides_no_friction(off):
    """It may be a stamp, of which a single one is left out all the same."""
    result = trace(_joint(off), JOINT)
    found = {(e.name, e.channel): [v for v, *_ in e.parameters.values()] for e in result.effects}
    assert found == {
        ("coulomb_friction", "qd"): [pytest.approx(1.5, rel=0.01)],
        ("viscous_friction", "qd"): [pytest.approx(1.2, rel=0.01)],
    }
    assert (result.faults, result.outliers) == ((), 1)


@pytest.mark.parametrize("rows", [800, ROWS])
def test_one_stray_row_is_left_out_of_any_recording(rows):
    data = _joint(0.0)
    (run,) = data.runs
    short = replace(data, runs=(replace(run, y=run.y[: rows + 1].copy(), u=run.u[:rows]),))
    fast = 100 + int(np.argmax(np.abs(short.runs[0].y[100:700, 1])))
    short.runs[0].y[fast, 0] += 0.02
    found = check(JOINT, short)
    assert (found.faults, found.outliers) == ((), 1)
    assert np.flatnonzero(np.isnan(found.data.runs[0].y).any(axis=1)).tolist() == [fast]


@pytest.mark.parametrize("where", ["slowest", "first", "last"])
def test_a_spike_where_the_robot_is_slow_is_no_row_that_was_stamped_late(where):
    """It is less than half of the fastest step away: as far as a row of a faster moment may be."""
    data = _joint(0.0)
    (run,) = data.runs
    step = np.abs(np.diff(run.y[:, 0]))
    at = 20 + int(np.argmin([np.max(step[k - 8 : k + 8]) for k in range(20, ROWS - 20)]))
    cut = {"slowest": slice(0, ROWS), "first": slice(at - 1, ROWS), "last": slice(0, at + 1)}[where]
    short = replace(data, runs=(replace(run, y=run.y[cut.start : cut.stop + 1].copy(), u=run.u[cut]),))
    spike = at - cut.start
    short.runs[0].y[spike, 0] += 0.4 * np.max(step)
    found = [
        (f.kind, f.channel, round((f.from_s - run.start_s) / data.dt), round((f.to_s - run.start_s) / data.dt))
        for f in check(JOINT, short).faults
    ]
    assert found == [("spike", "q", spike, spike)]


def test_rows_that_are_often_stamped_late_are_how_they_are_stamped():
    data, rng = _joint(0.0), np.random.default_rng(0)
    (run,) = data.runs
    late = np.sort(rng.choice(np.arange(10, ROWS - 10), 20, replace=False))
    run.y[late] = 0.5 * (run.y[late] + run.y[late - 1])  # read half a row earlier than they say
    found = check(JOINT, data)
    assert (found.faults, found.outliers) == ((), 0)
    assert not np.isnan(found.data.runs[0].y).any()


def test_rows_that_are_read_late_by_two_are_no_spikes():
    data, rng = _joint(0.0), np.random.default_rng(1)
    (run,) = data.runs
    late = np.sort(rng.choice(np.arange(10, ROWS - 10, 20), 6, replace=False))
    run.y[late] = run.y[late - 2]
    assert check(JOINT, data).faults == ()


def _cart(jump: float, seed: int = 1, other: float = 0.0) -> Dataset:
    """A cart that turns to and fro by steps, late and slowly; from half of the drive on its heading is read with an offset, and with
    another one for two seconds before.
    """
    slow = (EffectSpec("input_delay", "*", {"delay": 0.1}), *(EffectSpec("input_lag", u, {"time_constant": 0.12}) for u in ("v", "w")))
    robot = compose(ModelSpec("unicycle", 0.05, {}, slow))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform([0.0, -1.5], [0.5, 1.5], (120, 2)), 20, axis=0)
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(len(rows), 3)) * [0.001, 0.001, 0.004]
    y[1200:, 2] += jump
    y[600:640, 2] += other
    return from_arrays(CART, [(y, u)])


@pytest.mark.slow
def test_a_heading_that_jumps_by_what_the_commands_ask_within_a_step_is_seen_under_what_was_found():
    data = _cart(0.15)
    assert check(CART, data).faults == ()
    result = trace(data, CART)
    assert [(f.kind, f.channel, f.from_s) for f in result.faults] == [("offset_jump", "theta", pytest.approx(60.0))]
    named = {(e.name, e.channel) for e in (*result.effects, *result.partial)}
    assert named == {("input_delay", "*"), ("input_lag", "v"), ("input_lag", "w")}


@pytest.mark.slow
def test_a_jump_that_was_seen_hides_no_other_one():
    result = trace(_cart(0.15, other=1.2), CART)
    assert [(f.kind, f.channel, round(f.from_s)) for f in result.faults] == [("offset_jump", "theta", 30), ("offset_jump", "theta", 60)]


@pytest.mark.slow
def test_a_jump_of_the_recording_that_is_judged_on_is_left_out_of_it():
    """It would be taken for what the repaired model does not foretell."""
    sound, jumped = _cart(0.0), _cart(0.15, seed=2)
    result = trace(sound, CART, test=jumped)
    assert result.faults == ()
    assert rms(result.after.ends)[2] < 0.01


@pytest.mark.slow
def test_what_hits_its_stops_has_no_sensor_that_jumps():
    """Its speed does, whatever is found of the rest; positions do not."""
    robot = compose(ModelSpec("joint", DT_S, {"mass": 2.0}, (EffectSpec("viscous_friction", "qd", {"coefficient": 3.0}),)))
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-20.0, 20.0, ROWS // 50), 50)[:, None]
    x, hidden, rows = np.zeros((1, 2)), robot.at_rest(1), [np.zeros(2)]
    for k in range(ROWS):
        x, hidden = robot.step(x, 0.3 * u[k : k + 1], hidden)
        if abs(x[0, 0]) > 0.6:
            x = np.array([[np.clip(x[0, 0], -0.6, 0.6), 0.0]])
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(ROWS + 1, 2)) * [2e-5, 2e-3]
    data = from_arrays(JOINT, [(y, u)])
    assert trace(data, JOINT).faults == check(JOINT, data).faults


def test_without_a_jump_nothing_is_taken_for_one():
    result = trace(_cart(0.0), CART)
    assert (result.verdict, result.faults) == ("traced", ())
    assert {(e.name, e.channel) for e in result.effects} == {("input_delay", "*"), ("input_lag", "v"), ("input_lag", "w")}


@pytest.mark.filterwarnings("error")
def test_inputs_that_were_sent_twice_with_one_stamp_warn_nobody():
    rng = np.random.default_rng(0)
    t = np.sort(np.repeat(DT_S * np.arange(600), np.where(rng.random(600) < 0.1, 2, 1)))
    u = np.sin(2.0 * np.pi * 1.3 * t)[:, None]
    states = Stream(DT_S * np.arange(600), np.zeros((600, 2)))
    x = np.zeros((1, 2))
    for k in range(1, 600):
        x = JOINT.step(x, np.array([[np.sin(2.0 * np.pi * 1.3 * DT_S * (k - 1))]]), JOINT.at_rest(1))[0]
        states.values[k] = x[0]
    noisy = Stream(states.t, states.values + rng.normal(size=(600, 2)) * [1e-4, 1e-3])
    assert trace(from_streams(JOINT, [(noisy, Stream(t, u))], "here"), JOINT).verdict == "none"


@pytest.mark.parametrize(("at", "wrong_before"), [(0.38, False), (0.2, False), (0.6, True), (0.75, True)])
def test_of_a_heading_that_jumps_for_good_the_part_is_wrong_that_leaves_the_course(at, wrong_before):
    """However long that part is; a compass that was put right is no effect."""
    rng, n = np.random.default_rng(8), 1200
    u = np.repeat(rng.uniform([0.1, -2.0], [0.25, 2.0], (n // 15, 2)), 15, axis=0)
    robot, x, rows = CART, np.zeros((1, 3)), []
    hidden = robot.at_rest(1)
    for row in u:
        rows.append(x[0])
        x, hidden = robot.step(x, row[None], hidden)
    y = np.array(rows) + rng.normal(size=(n, 3)) * [1e-3, 1e-3, 7e-3]
    jump = round(at * n)
    y[slice(0, jump) if wrong_before else slice(jump, n), 2] += 0.5
    found = trace(from_arrays(CART, [(y, u[:-1])]), CART)
    assert found.verdict == "sensor_fault"
    assert not found.effects
    (fault,) = found.faults
    near = pytest.approx(0.05 * jump, abs=0.3)
    assert fault.channel == "theta"
    assert (fault.from_s, fault.to_s) == ((0.0, near) if wrong_before else (near, pytest.approx(0.05 * (n - 1), abs=0.3)))
