"""What was received is told from what was only repeated, and streams on stamps of their own are brought together."""

import numpy as np
import pytest

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_streams, thinned
from s2r_runtime.trace.data.streams import Stream, complete, fresh, nearest, turned
from s2r_runtime.trace.sensor_faults.detect import check


def _pose(t):
    return np.stack([t, 0.3 * np.sin(t), 0.5 * t], axis=1)


def _model(dt=0.05):
    return compose(ModelSpec("unicycle", dt))


def test_rows_that_repeat_a_slower_sensor_are_no_measurements():
    rng, t = np.random.default_rng(1), 0.05 * np.arange(400)
    y = _pose(t) + 1e-3 * rng.normal(size=(400, 3))
    again = rng.random(400) < 0.45
    again[::5] = False  # a recorder repeats a few rows at a time
    for k in np.flatnonzero(again):
        y[k] = y[k - 1]
    seen = fresh(Stream(t, y))
    assert np.array_equal(np.isnan(seen.values[:, 0]), again)
    data = from_streams(_model(), [(Stream(t, y), Stream(t, np.tile([1.0, 0.5], (400, 1))))], "here")
    model, data, _ = thinned(_model(), data)
    assert "frozen" not in {f.kind for f in check(model, data).faults}


@pytest.mark.parametrize("quantum", [1e-3, 1e-2])
def test_a_coarse_sensor_that_repeats_by_itself_is_measured_all_the_same(quantum):
    t = 0.05 * np.arange(400)
    y = np.rint(_pose(0.1 * t) / quantum) * quantum
    assert not np.isnan(fresh(Stream(t, y)).values).any()


def test_a_sensor_that_stood_still_for_long_is_left_to_the_search_for_faults():
    t = 0.05 * np.arange(400)
    y = _pose(t) + 1e-3 * np.random.default_rng(2).normal(size=(400, 3))
    y[100:160] = y[100]
    assert not np.isnan(fresh(Stream(t, y)).values).any()


def test_states_on_rows_of_their_own_meet_on_those_of_the_rarest_but_not_across_its_gaps():
    t = 0.05 * np.arange(200)
    values = _pose(t)
    values[::2, :2] = np.nan
    values[1::2, 2] = np.nan
    values[60:80, 2] = np.nan
    met = complete(Stream(t, values))
    assert np.allclose(met.values, _pose(met.t), atol=2e-3)
    assert not np.any((met.t > t[60]) & (met.t < t[79]))


def test_a_state_between_the_others_stamps_is_brought_there_as_the_inputs_moved_it():
    rng = np.random.default_rng(3)
    t = 0.05 * np.arange(201)
    w = rng.uniform(-2.0, 2.0, 101)  # held for a tenth of a second each, from the stamps of the position on
    heading = np.interp(t, 0.1 * np.arange(102), np.concatenate([[0.0], np.cumsum(0.1 * w)]))
    values = np.column_stack([np.cos(t), np.sin(t), heading])
    values[1::2, :2] = np.nan
    values[::2, 2] = np.nan
    inputs = Stream(0.1 * np.arange(101), np.column_stack([np.zeros(101), w]))
    straight, bent = (
        complete(Stream(t, values)),
        complete(Stream(t, values), inputs, lambda x, u: np.column_stack([u[:, 0], u[:, 0], u[:, 1]])),
    )
    assert np.allclose(bent.t, t[2:-1:2]), "on the stamps of two states, not of one"
    true = np.interp(bent.t, t, heading)
    assert np.allclose(bent.values[:, 2], true, atol=1e-9)
    assert np.max(np.abs(straight.values[:, 2] - true)) > 0.01


def test_steps_between_rows_that_are_rarer_than_the_model_s_are_taken_together():
    t = 0.1 * np.arange(300)
    data = from_streams(_model(0.05), [(Stream(t, _pose(t)), Stream(t, np.ones((300, 2))))], "here")
    model, data, _ = thinned(_model(0.05), data)
    assert model.dt == pytest.approx(0.1)
    assert len(data.runs[0].y) == 300


def test_inputs_from_before_the_first_state_are_kept():
    t = 0.05 * np.arange(100)
    inputs = np.stack([np.arange(100.0), np.zeros(100)], axis=1)
    data = from_streams(_model(), [(Stream(t[20:], _pose(t[20:])), Stream(t, inputs))], "here")
    run = data.runs[0]
    assert np.isnan(run.y[:20]).all()
    assert not np.isnan(run.y[20:]).any()
    assert run.start_s == pytest.approx(-1.0)
    assert np.array_equal(run.u[:20, 0], np.arange(20.0))


def test_an_input_given_once_long_before_still_holds():
    t = 60.0 + 0.05 * np.arange(100)
    data = from_streams(_model(), [(Stream(t, _pose(t)), Stream(np.array([55.0]), np.array([[1.0, 0.5]])))], "here")
    assert np.allclose(data.runs[0].u, [1.0, 0.5])


@pytest.mark.parametrize("shift", [3600.0, -3600.0])
def test_inputs_and_states_that_share_no_time_are_of_two_clocks(shift):
    t = 0.05 * np.arange(100)
    with pytest.raises(RecordingError, match="their stamps must be of one clock"):
        from_streams(_model(), [(Stream(t, _pose(t)), Stream(t + shift, np.ones((100, 2))))], "here.csv")


@pytest.mark.parametrize(("before_s", "over"), [(0.0049, True), (0.0042, True), (0.0011, True), (0.0005, False), (0.0051, False)])
def test_a_change_anywhere_in_the_last_part_of_a_step_but_on_its_end_is_over_by_then(before_s, over):
    """Steps of 0.05 s in ten parts; what comes within 1 ms of a stamp may as well be on it."""
    at = 0.05 * np.arange(6)
    inputs = Stream(np.array([0.0, at[3] - before_s]), np.array([[1.0], [2.0]]))
    found = turned(inputs, at, 10, on_edge=0.001)
    assert (found is not None and found[:, 0].tolist() == [False, False, True, False, False]) == over


@pytest.mark.parametrize("pause", [7.0, 7.25, 7.4, 7.5, 7.6, 7.75])
def test_no_row_is_lost_behind_a_pause_that_ends_within_a_step(pause):
    """Rows jitter by a tenth of a step, and have a point each, in their order, with the stamp that they have."""
    place = np.arange(300.0) + np.random.default_rng(8).uniform(-0.1, 0.1, 300)
    place[0] = 0.0
    place[100:] += pause
    t = 0.05 * place
    y, at = nearest(Stream(t, t[:, None]), 0.05, [])
    there = np.isfinite(y[:, 0])
    assert np.array_equal(y[there, 0], t)
    assert np.array_equal(at[there], t)
    assert (np.diff(at) > 0.0).all()
    assert np.abs(at / 0.05 - np.arange(len(at))).max() < 0.7


def test_rows_that_come_a_little_faster_than_the_grid_are_where_they_are():
    """None of the points between two pauses is half a step away for all of them: only the nearest rows are taken."""
    place = np.concatenate([0.97 * np.arange(200.0), 220.5 + 0.97 * np.arange(200.0)])
    _, at = nearest(Stream(place, place[:, None]), 1.0, [])
    assert np.abs(at - np.arange(len(at))).max() <= 0.5


def test_of_rows_that_come_twice_a_step_the_nearest_counts():
    t = 0.025 * np.arange(200)
    y, at = nearest(Stream(t, t[:, None]), 0.05, [])
    assert y[:, 0] == pytest.approx(at)
    assert at[:-1] == pytest.approx(0.05 * np.arange(len(at) - 1))


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("late", [0.4, 0.6, 1.0])
def test_stamps_of_arrival_stay_in_their_order(late, seed):
    """Rows come late by a part of a step, or by several: two may have one point, of which the nearer counts."""
    rng = np.random.default_rng(seed)
    place = np.sort(np.arange(1000.0) + rng.exponential(late, 1000))
    t = 0.05 * (place - place[0])
    y, at = nearest(Stream(t, t[:, None]), 0.05, [])
    assert (np.diff(at) > 0.0).all()
    there = np.isfinite(y[:, 0])
    assert np.array_equal(y[there, 0], at[there])
    assert np.count_nonzero(there) >= len(np.unique(np.rint(place - place[0])))  # as the nearest points would have
