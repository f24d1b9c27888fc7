"""A heading that comes late against the positions is told, and taken earlier; what slides sideways is no late heading."""

import json

import numpy as np
import pytest
from trace_sets.families import make

from s2r_runtime.cli.main import main
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.sensor_faults.pose_latency import _asked, _turns_sooner, earlier, late_pose

PARTS, ROW_S, ROWS = 20, 0.025, 1600
NOISE = np.array([0.001, 0.001, 0.003])


def _driven(late_rows=(0, 0), slip_s=0.0, follows_s=0.0, ahead_m=0.0, seed=0):
    """(t, pose, inputs) of a robot that moves on arcs. late_rows: of the positions, of the heading; slip_s: it slides by that much of its
    speed and yaw rate, following by a lag; ahead_m: where it is measured."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform([0.2, -1.2], [0.8, 1.2], (ROWS // 40, 2)), 40, axis=0)
    dt, fine = ROW_S / PARTS, np.repeat(u, PARTS, axis=0)
    theta = np.append(0.0, np.cumsum(dt * fine[:, 1]))
    aside, slides = np.zeros(len(fine)), 0.0
    for k, (v, w) in enumerate(fine):
        slides += (slip_s * v * w - slides) * (dt / follows_s if follows_s else 1.0)
        aside[k] = slides
    middle = 0.5 * (theta[1:] + theta[:-1])
    x = np.append(0.0, np.cumsum(dt * (fine[:, 0] * np.cos(middle) - aside * np.sin(middle)))) + ahead_m * np.cos(theta)
    y = np.append(0.0, np.cumsum(dt * (fine[:, 0] * np.sin(middle) + aside * np.cos(middle)))) + ahead_m * np.sin(theta)
    rows = PARTS * np.arange(ROWS)
    where, heading = (np.maximum(rows - round(PARTS * late), 0) for late in late_rows)
    pose = np.column_stack([x[where], y[where], theta[heading]]) + NOISE * rng.normal(size=(ROWS, 3))
    return ROW_S * np.arange(ROWS), pose, u


def _late(**what):
    t, pose, u = _driven(**what)
    return late_pose(compose(ModelSpec("unicycle", 0.05)), [(Stream(t, pose), Stream(t, u))], ())


@pytest.mark.parametrize("rows", [3, 4.4])
def test_a_heading_that_comes_late_is_told(rows):
    found = _late(late_rows=(0, rows))
    assert found == {"theta": pytest.approx(rows * ROW_S, rel=0.05)}


def test_a_position_that_is_off_hides_no_late_heading():
    t, pose, u = _driven(late_rows=(0, 4))
    pose[900, 0] += 0.5
    pose[1200:, 1] += 1.0
    found = late_pose(compose(ModelSpec("unicycle", 0.05)), [(Stream(t, pose), Stream(t, u))], ())
    assert found == {"theta": pytest.approx(4 * ROW_S, rel=0.05)}


def test_rows_that_are_off_by_themselves_make_no_late_heading():
    """A controller answers a position that is off, so that turns follow ways that nobody went; this car's heading seemed 0.48 s late."""
    (run,) = make("one", 300022).recording.runs
    t, pose = run.t, run.y[:, :3]
    assert late_pose(compose(ModelSpec("unicycle", 0.04)), [(Stream(t, pose), Stream(t[:1], np.zeros((1, 2))))], ()) == {}


@pytest.mark.slow
def test_a_short_recording_is_not_cut_down_to_what_a_long_delay_leaves():
    """Half a second at 1000 Hz, and a heading that is 1.2 rad off: one that stands still past the end seemed 0.49 s late."""
    made = make("one", 386005)
    (run,) = made.recording.runs
    model = compose(ModelSpec(made.model["name"], made.model["dt"], made.model["parameters"]))
    assert late_pose(model, [(Stream(run.t, run.y), Stream(run.t_u, run.u))], ()) == {}


def test_a_heading_that_wandered_off_for_a_while_is_not_late():
    """The drift of a gyroscope looks like one that lags, as long as it lasts."""
    for seed in (302010, 302019):
        made = make("fault", seed)
        (run,) = made.recording.runs
        model = compose(ModelSpec(made.model["name"], made.model["dt"], made.model["parameters"]))
        assert late_pose(model, [(Stream(run.t, run.y), Stream(run.t_u, run.u))], ()) == {}


def test_positions_that_come_late_are_told():
    found = _late(late_rows=(4, 0))
    assert found == dict.fromkeys(("x", "y"), pytest.approx(4 * ROW_S, rel=0.05))


@pytest.mark.parametrize(
    "what",
    [{}, {"slip_s": 0.1}, {"slip_s": -0.1}, {"slip_s": -0.1, "follows_s": 0.1}, {"ahead_m": 0.1}, {"ahead_m": -0.1}, {"late_rows": (4, 4)}],
    ids=str,
)
def test_what_slides_or_is_measured_elsewhere_is_not_late(what):
    assert _late(**what) == {}


def test_a_state_that_is_taken_earlier_falls_on_the_rows_of_the_others_where_it_can():
    t = np.arange(6.0)
    states = Stream(t, np.column_stack([t, 10.0 * t]))
    (moved, _), *_ = earlier([(states, states)], ("x", "theta"), {"theta": 2.0})
    np.testing.assert_allclose(moved.t, t[:4])
    np.testing.assert_allclose(moved.values, np.column_stack([t[:4], 10.0 * (t[:4] + 2.0)]))
    (between, _), *_ = earlier([(states, states)], ("x", "theta"), {"theta": 0.5})
    np.testing.assert_allclose(between.t[:3], [0.0, 0.5, 1.0])
    np.testing.assert_allclose(between.values[1], [np.nan, 10.0])


def test_a_late_heading_is_a_fault_of_measurement_and_no_delay(tmp_path, capsys):
    report = tmp_path / "page.html"
    t, pose, u = _driven(late_rows=(0, 4))
    path = tmp_path / "drive.csv"
    np.savetxt(path, np.column_stack([t, pose, u]), delimiter=",", header="t,x,y,theta,v,w", comments="", fmt="%.7g")
    assert main(["trace", str(path), "--model", "unicycle", "--dt", "0.05", "--json", "--report", str(report)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [(e["name"], e["channel"]) for e in told["effects"]] in ([], [("integration_scheme", "*")])
    assert [(f["kind"], f["channel"], f["from_s"]) for f in told["faults"]] == [("late", "theta", 0.0)]
    assert told["states_late"] == {"theta": pytest.approx(4 * ROW_S, rel=0.05)}
    assert "shifted by that" in report.read_text()
    assert "affected samples are excluded" not in report.read_text()


NAMES = ("x", "y", "theta")


def _sooner(t, pose, inputs, model=None):
    """Whether a heading seems to answer inputs (a Stream) sooner than one that is 0.14 s late can."""
    model, states = model or compose(ModelSpec("unicycle", 0.05)), Stream(t, pose)
    return _turns_sooner(states, _asked(model, NAMES, states, inputs), 0.14)


@pytest.mark.parametrize("seed", range(4))
def test_a_heading_that_turns_when_it_is_asked_to_is_not_late(seed):
    """What slides by its speed and yaw rate looks like a heading that is as many seconds late, to first order: the inputs tell."""
    t, pose, u = _driven(slip_s=0.14, seed=seed)
    assert _sooner(t, pose, Stream(t, u))
    for rows in (5.6, 12.0):  # it may turn late, too
        t, pose, u = _driven(late_rows=(0, rows), seed=seed)
        assert not _sooner(t, pose, Stream(t, u))


def test_it_makes_no_difference_how_inputs_are_written():
    """Each input stands until another value of it is written."""
    t, pose, u = _driven(slip_s=0.14)
    few = np.flatnonzero(np.append(True, np.any(u[1:] != u[:-1], axis=1)))
    apart = u.copy()
    apart[1::2, 0], apart[::2, 1] = np.nan, np.nan
    assert _sooner(t, pose, Stream(t[few], u[few]))
    assert _sooner(t, pose, Stream(t, apart))


@pytest.mark.parametrize(("heading", "stamps"), [(5.6, 5), (5.6, 4), (3.0, 3)])
def test_inputs_that_are_stamped_late_say_nothing_of_a_heading(heading, stamps):
    """Positions answer them before they are asked to."""
    t, pose, u = _driven(late_rows=(0, heading))
    assert not _sooner(t, pose, Stream(t + stamps * ROW_S, u))


@pytest.mark.parametrize("seed", range(3))
def test_what_the_inputs_say_goes_before_the_ways(seed):
    """Yaw rates that the late sensor itself measured turn with it: by the ways alone the heading is late, and that cannot be told then."""
    t, pose, u = _driven(late_rows=(0, 4), seed=seed)
    measured = np.column_stack([u[:, 0], np.concatenate([np.full(4, u[0, 1]), u[:-4, 1]])])
    model = compose(ModelSpec("unicycle", 0.05))
    assert late_pose(model, [(Stream(t, pose), Stream(t, u))], ()) == {"theta": pytest.approx(4 * ROW_S, rel=0.05)}
    assert late_pose(model, [(Stream(t, pose), Stream(t, measured))], ()) == {}


MEASURED = """
import numpy as np

STATES, INPUTS, PARAMS, ANGLES = ("x", "y", "theta", "load"), ("v", "w"), {}, ("theta",)


def step(x, u, dt, params):
    after = x.copy()
    after[:, 0] += dt * u[:, 0] * np.cos(x[:, 2])
    after[:, 1] += dt * u[:, 0] * np.sin(x[:, 2])
    after[:, 2] += dt * u[:, 1]
    return after
"""


def test_a_state_without_a_value_ends_no_question_about_the_heading(tmp_path):
    """Another state, of somebody's own model, that the longest segment lacks."""
    path = tmp_path / "loaded.py"
    path.write_text(MEASURED)
    model = compose(ModelSpec(str(path), 0.05))
    t, pose, u = _driven(late_rows=(0, 4))
    lacking = np.column_stack([pose, np.full(len(t), np.nan)])
    assert late_pose(model, [(Stream(t, lacking), Stream(t, u))], ()) == {"theta": pytest.approx(4 * ROW_S, rel=0.05)}


def test_a_yaw_rate_that_is_measured_is_no_input():
    """What the model makes of a state is not what the inputs ask for."""
    t, pose, _ = _driven(late_rows=(0, 5.6))
    assert not _sooner(t, pose, Stream(t, np.zeros((len(t), 2))))
    assert not _sooner(t, pose, Stream(t[:0], np.zeros((0, 2))))
