"""Recordings in several runs whose stamps all begin at zero, as windows of a drive: faults that go over from one to the next."""

import numpy as np
import pytest
from trace_robots import GEOMETRY, commands

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.report.trace_page import trace_page
from s2r_runtime.trace.pipeline import load_dataset, trace
from s2r_runtime.trace.sensor_faults.detect import check
from s2r_runtime.trace.sensor_faults.heading import carried

DT, RUNS, ROWS = 0.05, 24, 60
NAMES = [f"d{k + 1}" for k in range(RUNS)]


def _drives(name="unicycle", effects=(), seed=1, noise=(1e-3, 1e-3, 3e-3), bounds=((0.1, 0.4), (-1.0, 1.0))):
    """Runs (y, u) from the same place, at a heading of their own."""
    robot = compose(ModelSpec(name, DT, GEOMETRY.get(name, {}), tuple(EffectSpec(*e) for e in effects)))
    rng, runs = np.random.default_rng(seed), []
    for _ in range(RUNS):
        u = commands(rng, 1, ROWS, DT, list(bounds))[0]
        x, hidden, rows = np.array([[0.0, 0.0, rng.uniform(-3.0, 3.0)]]), robot.at_rest(1), []
        for k in range(ROWS):
            rows.append(x[0])
            x, hidden = robot.step(x, u[k : k + 1], hidden)
        runs.append((np.array(rows) + rng.normal(size=(ROWS, 3)) * noise, u))
    return runs


def _written(path, runs):
    rows = ["segment,t,x,y,theta,v,w"]
    for name, (y, u) in zip(NAMES, runs, strict=True):
        rows += [f"{name},{DT * k:.3f}," + ",".join("" if np.isnan(v) else repr(float(v)) for v in (*y[k], *u[k])) for k in range(len(y))]
    path.write_text("\n".join(rows) + "\n")
    return path


def _found(tmp_path, runs):
    model = compose(ModelSpec("unicycle", DT))
    return check(model, load_dataset(_written(tmp_path / "d.csv", runs), model))


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_a_heading_that_is_frozen_over_several_runs_is_found_in_each(tmp_path, lost):
    """In the middle of one it stops, and in the middle of another it goes on. Rows that are lost meanwhile do not hide it."""
    runs = _drives()
    for k in range(9, 13):
        runs[k][0][(25 if k == 9 else 0) : (40 if k == 12 else ROWS), 2] = 0.7
    rng = np.random.default_rng(3)
    for y, _ in runs:
        y[1:-1][rng.uniform(size=ROWS - 2) < lost] = np.nan
    faults = [f for f in _found(tmp_path, runs).faults if f.kind == "frozen"]
    assert {(f.channel, f.segment) for f in faults} == {("theta", NAMES[k]) for k in range(9, 13)}
    first, last = faults[0], faults[-1]
    assert first.from_s == pytest.approx(25 * DT, abs=3 * DT)
    assert last.to_s == pytest.approx(39 * DT, abs=3 * DT)


@pytest.mark.parametrize("until", [ROWS, 40])
def test_a_robot_whose_runs_begin_at_rest_and_late_is_not_frozen(tmp_path, until):
    """Without noise, and straight on for whole runs: what repeats is what the robot does."""
    runs = _drives(effects=[("input_delay", "*", {"delay": 0.7}), ("input_deadband", "w", {"width": 0.3})], noise=(0.0, 0.0, 0.0))
    for _, u in runs[:3]:
        u[:until, 1] = 0.2
    assert not [f for f in _found(tmp_path, runs).faults if f.kind == "frozen"]


@pytest.mark.parametrize(("first", "jump"), [(15, 0.4), (15, -0.9), (5, 0.4), (11, 1.57)])
def test_a_compass_that_jumps_in_one_run_is_off_in_all_that_follow(tmp_path, first, jump):
    """Where it was right before, those that follow are left out; it is right before, as the course says, also if that leaves less."""
    runs = _drives()
    for k in range(first, RUNS):
        runs[k][0][(30 if k == first else 0) :, 2] += jump
    found = _found(tmp_path, runs)
    jumps = [f for f in found.faults if f.kind == "offset_jump"]
    assert {(f.channel, f.segment) for f in jumps} == {("theta", NAMES[k]) for k in range(first, RUNS)}
    assert found.outliers == 0  # what a fault takes out is told as one
    assert jumps[0].from_s == pytest.approx(DT * 30, abs=1.01 * DT)
    assert all(np.isnan(run.y).any(axis=1).all() for run in found.data.runs[first + 1 :])


def test_wild_positions_hide_no_compass_that_jumped(tmp_path):
    """Of so many wild rows, jumps count only if they stay: then the runs that follow are told, too, and are no outliers."""
    runs, rng = _drives(), np.random.default_rng(9)
    for k in range(15, RUNS):
        runs[k][0][(30 if k == 15 else 0) :, 2] += 0.4
    for y, _ in runs:
        wild = rng.uniform(size=ROWS) < 0.03
        y[wild, 0] += rng.choice([-0.4, 0.4], np.count_nonzero(wild))
    found = _found(tmp_path, runs)
    assert {(f.channel, f.segment) for f in found.faults} == {("theta", NAMES[k]) for k in range(15, RUNS)}
    assert 15 < found.outliers < 70  # three of a hundred of 1440


@pytest.mark.slow
def test_what_is_found_beside_it_is_what_the_robot_does(tmp_path):
    runs = _drives(effects=[("input_gain", "w", {"gain": 0.8})])
    for k in range(15, RUNS):
        runs[k][0][(30 if k == 15 else 0) :, 2] += 0.4
    model = compose(ModelSpec("unicycle", DT))
    found = trace(load_dataset(_written(tmp_path / "d.csv", runs), model), model)
    assert [(e.name, e.channel) for e in found.effects] in ([("input_gain", "w")], [("track_scale", "theta")])
    assert found.effects[0].parameters["gain"][0] == pytest.approx(0.8, abs=0.02)
    text = found.text()
    assert "offset_jump of theta in segments d16, d17, d18, d19, d20, d21, d22, d23 and 1 more (all of them: --json)" in " ".join(
        text.split()
    )
    assert [f["segment"] for f in found.to_json()["faults"]] == NAMES[15:]
    assert '<td class="n">d20</td>' in trace_page(found)


def test_a_jump_that_the_course_of_other_runs_does_not_show_is_of_its_own_run():
    """And one that all of them show is theirs: by as much, and the other way."""
    rng, runs = np.random.default_rng(6), []
    for k in range(RUNS):
        heading = np.cumsum(np.full(ROWS, 0.02)) + rng.uniform(-3.0, 3.0)
        steps = 0.02 * np.column_stack([np.cos(heading), np.sin(heading)])
        runs.append(np.column_stack([np.cumsum(steps, axis=0), heading + (0.5 if k > 10 else 0.0)]))
    assert carried(runs, {10: 0.5}) == [*range(11, RUNS)]
    for jumps in ({10: -0.5}, {10: 1.2}, {4: 0.2}, {}):
        assert carried(runs, jumps) == []


@pytest.mark.parametrize("rounded", [None, 1e-5])
@pytest.mark.parametrize("case", ["all of it", "its place", "its heading"])
def test_what_holds_a_robot_while_it_is_asked_to_move_is_no_frozen_sensor(tmp_path, case, rounded):
    """To the end of a run, without noise, as encoders say it: by an emergency stop, at a wall where it turns on, by a rail along which it
    goes on.
    """
    for seed in range(3):
        runs = [(y[:45], u[:45]) for y, u in _drives(noise=(0.0, 0.0, 0.0), seed=10 + seed)]  # of longer ones, exact repeats alone say it
        for y, u in runs[4:8]:
            columns = {"its place": [0, 1], "its heading": [2]}.get(case, [0, 1, 2])
            y[20:, columns] = y[20, columns]
            if case == "its heading":
                way = DT * np.cumsum(u[20:-1, 0])[:, None]
                y[21:, :2] = y[20, :2] + way * [np.cos(y[20, 2]), np.sin(y[20, 2])]
        if rounded:
            runs = [(np.round(y / rounded) * rounded, u) for y, u in runs]
        assert not [f for f in _found(tmp_path, runs).faults if f.kind == "frozen"]


@pytest.mark.slow
def test_runs_that_all_begin_at_the_origin_have_a_noise_floor(tmp_path):
    """Rollouts begin where every window does, and may leave that place: the noise of what they end at is no rounding error."""
    runs = _drives(effects=[("input_gain", "w", {"gain": 0.7})], noise=(0.02, 0.02, 0.02))
    for y, _ in runs:
        x0, c, s = y[0].copy(), np.cos(y[0, 2]), np.sin(y[0, 2])
        y[:, :2] = (y[:, :2] - x0[:2]) @ np.array([[c, -s], [s, c]])
        y[:, 2] -= x0[2]
    model = compose(ModelSpec("unicycle", DT))
    found = trace(load_dataset(_written(tmp_path / "d.csv", runs), model), model, horizon=DT * (ROWS - 1)).to_json()["error"]
    for state in ("x", "y", "theta"):
        assert found["rollout_noise_floor"][state] > 0.3 * found["after"]["rollout_rms"][state]
