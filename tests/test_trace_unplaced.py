"""Commands that changed between two rows, nobody knows when: the transitions in which they did are left out and told, and no others."""

import numpy as np
import pytest
from seeds import first
from trace_robots import GEOMETRY, drive

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.command_timing import before_changes
from s2r_runtime.trace.data.dataset import from_streams
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.pipeline import trace

pytestmark = pytest.mark.slow

DT, PARTS, ROWS = 0.05, 20, 700
NOISE = {"differential_drive": [1e-3, 1e-3, 1e-3, 5e-3, 5e-3], "bicycle": [1e-3, 1e-3, 1e-3, 2e-3], "unicycle": [1e-3, 1e-3, 1e-3]}
BOUNDS = {"differential_drive": ([-3.0, -3.0], [8.0, 8.0]), "bicycle": ([-0.4, 0.3], [0.4, 1.5]), "unicycle": ([0.1, -1.2], [0.8, 1.2])}


def _model(name):
    return compose(ModelSpec(name, DT, GEOMETRY.get(name, {}), (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))


def _filled_up(name, seed=0, on_rows=False, effects=(), after=lambda u: u, every=12.7):
    """Streams of a table whose commands came every so many rows, or on every 12th, and stand on the rows from then on. after: what acts."""
    rng = np.random.default_rng(seed)
    held = 12 * PARTS if on_rows else int(every * PARTS)
    low, high = BOUNDS[name]
    levels = rng.uniform(low, high, (PARTS * ROWS // held + 1, len(low)))
    fine = np.repeat(levels, held, axis=0)[: PARTS * ROWS]
    y = drive(rng, name, after(fine)[None], list(effects), DT / PARTS, 0.0)[0][:-1:PARTS]
    t = DT * np.arange(ROWS)
    return Stream(t, y + rng.normal(size=y.shape) * NOISE[name]), Stream(t, fine[::PARTS])


@pytest.mark.parametrize("name", first(1, ["bicycle", "differential_drive"]))
def test_commands_of_another_clock_leave_out_the_transitions_in_which_they_change(name):
    model = _model(name)
    data = from_streams(model, [_filled_up(name)], "here.csv")
    found = trace(data, model)
    assert found.verdict == "none"
    assert found.depends_on == ()
    told, json = " ".join(found.text().split()), found.to_json()
    assert not json["inputs_changed_within"]
    changed = np.flatnonzero(np.any(np.diff(data.segments[0][1].values, axis=0), axis=1))
    assert [k for _, k in before_changes(data)] == sorted({*changed.tolist(), ROWS - 2})  # nobody knows what was asked after the last one
    assert json["changes_left_out"] == len(before_changes(data))
    assert f"left out: {json['changes_left_out']} transitions in which a command changes" in told


def test_where_the_motion_says_when_they_came_none_is_left_out():
    model = _model("unicycle")
    found = trace(from_streams(model, [_filled_up("unicycle")], "here.csv"), model)
    assert (found.verdict, found.depends_on, found.unplaced, found.way.within) == ("none", (), 0, True)


@pytest.mark.slow
def test_an_effect_beside_them_is_named_and_the_other_recording_loses_its_changes_too():
    name = "differential_drive"
    model, slow = _model(name), [("input_gain", "cmd_left", {"gain": 0.9})]
    data, test = (from_streams(model, [_filled_up(name, seed, effects=slow)], f"{seed}.csv") for seed in (1, 2))
    found = trace(data, model, test=test)
    assert {(e.name, e.channel) for e in found.effects} == {("input_gain", "cmd_left")}
    assert found.effects[0].parameters["gain"][0] == pytest.approx(0.9, abs=0.002)
    assert found.unplaced == len(before_changes(data))
    assert not {(i, k) for i, k in before_changes(test)} & {(0, int(place)) for place in found.held.steps.place}


def test_a_lag_on_rows_is_a_lag():
    name = "differential_drive"
    slow = [("input_lag", channel, {"time_constant": 2.0 * DT}) for channel in ("cmd_left", "cmd_right")]
    model = _model(name)
    found = trace(from_streams(model, [_filled_up(name, on_rows=True, effects=slow)], "here.csv"), model)
    assert {(e.name, e.channel) for e in found.effects} == {("input_lag", "cmd_left"), ("input_lag", "cmd_right")}
    assert found.unplaced == 0


@pytest.mark.parametrize("share", first(1, [0.3, 0.15, 0.6]))
def test_a_delay_of_a_part_of_a_row_is_never_left_out(share):
    name = "differential_drive"
    model, slow = _model(name), [("input_delay", "*", {"delay": share * DT})]
    found = trace(from_streams(model, [_filled_up(name, on_rows=True, effects=slow)], "here.csv"), model)
    assert found.verdict != "none"
    assert found.unplaced == 0


def test_a_push_that_is_answered_by_a_command_is_not_left_out():
    """A wheel slips for a moment, and the next command answers: what happened before it is no part of what it does."""
    name = "differential_drive"
    model = _model(name)
    states, inputs = _filled_up(name, on_rows=True)
    changes = np.flatnonzero(np.any(np.diff(inputs.values, axis=0), axis=1))
    y, rng = states.values.copy(), np.random.default_rng(5)
    y[changes + 1, 3:] += rng.choice([-1.0, 1.0], (len(changes), 2)) * 1.5
    found = trace(from_streams(model, [(Stream(states.t, y), inputs)], "here.csv"), model)
    assert found.unplaced == 0


@pytest.mark.slow
def test_of_commands_that_change_in_every_third_row_none_is_left_out():
    """Rollouts would end after two steps, and say nothing of what a model does in the long run."""
    name = "differential_drive"
    model = _model(name)
    data = from_streams(model, [_filled_up(name, every=2.7)], "here.csv")
    assert len(before_changes(data)) > 0.3 * ROWS
    assert trace(data, model).unplaced == 0


@pytest.mark.parametrize("rows", first(1, [3, 1]))
def test_what_shoots_over_after_a_change_is_not_left_out(rows):
    """It has no name, and comes after the change: leaving out the transitions before would explain nothing."""

    def shoots_over(u):
        late = np.concatenate([np.repeat(u[:1], rows * PARTS, axis=0), u[: -rows * PARTS]])
        return u + 0.4 * (u - late)

    name = "differential_drive"
    model = _model(name)
    found = trace(from_streams(model, [_filled_up(name, on_rows=True, after=shoots_over)], "here.csv"), model)
    assert {*found.depends_on} - {"noise"}
    assert found.unplaced == 0
