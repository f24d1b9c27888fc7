"""Recordings in several runs whose stamps all begin at zero, as windows of a drive: faults that go over from one to the next."""

import numpy as np
import pytest
from trace_robots import GEOMETRY, commands

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.faults import check
from s2r_runtime.trace.heading import carried
from s2r_runtime.trace.tracer import load_dataset, trace

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


@pytest.mark.parametrize("row", [0, 30])
def test_a_compass_that_is_set_anew_is_off_in_all_runs_that_follow(tmp_path, row):
    """Between two runs, or within one; where it was right before, those that follow are left out."""
    runs = _drives()
    for k in range(15, RUNS):
        runs[k][0][(row if k == 15 else 0) :, 2] += 0.4
    found = _found(tmp_path, runs)
    jumps = [f for f in found.faults if f.kind == "offset_jump"]
    assert {(f.channel, f.segment) for f in jumps} == {("theta", NAMES[k]) for k in range(15, RUNS)}
    assert found.outliers == 0  # what a fault takes out is told as one
    assert jumps[0].from_s == pytest.approx(DT * row, abs=1.01 * DT)
    assert all(np.isnan(run.y).any(axis=1).all() for run in found.data.runs[16:])


def test_what_is_found_beside_it_is_what_the_robot_does(tmp_path):
    runs = _drives(effects=[("input_gain", "w", {"gain": 0.8})])
    for k in range(15, RUNS):
        runs[k][0][:, 2] += 0.4
    model = compose(ModelSpec("unicycle", DT))
    found = trace(load_dataset(_written(tmp_path / "d.csv", runs), model), model)
    assert [(e.name, e.channel) for e in found.effects] in ([("input_gain", "w")], [("track_scale", "theta")])
    assert found.effects[0].parameters["gain"][0] == pytest.approx(0.8, abs=0.02)
    text = found.text()
    assert "offset_jump of theta in segments d16, d17, d18, d19, d20, d21, d22, d23 and 1 more (all of them: --json)" in " ".join(
        text.split()
    )
    assert [f["segment"] for f in found.to_json()["faults"]] == NAMES[15:]


OTHERWISE = {
    "wind, and the heading changes with the runs": ([("constant_disturbance", "world", {"x": 0.1, "y": 0.0})], "heading"),
    "sliding in curves, to one side and then to the other": ([("lateral_slip", "*", {"coefficient": 0.4})], "turn"),
    "nothing": ([], ""),
}


@pytest.mark.parametrize("case", OTHERWISE)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_else_makes_a_course_is_no_compass(case, seed):
    """The second half of the runs is driven the other way, in the wind, or round the other way."""
    effects, what = OTHERWISE[case]
    robot = compose(ModelSpec("unicycle", DT, {}, tuple(EffectSpec(*e) for e in effects)))
    rng, runs = np.random.default_rng(seed), []
    for k in range(RUNS):
        late = k >= RUNS // 2
        heading = rng.normal(scale=0.3) + (1.3 if late else -1.3) * (what == "heading")
        turn = rng.uniform(0.3, 0.9) * (-1.0 if late and what == "turn" else 1.0)
        x, hidden, rows = np.array([[0.0, 0.0, heading]]), robot.at_rest(1), []
        for _ in range(ROWS):
            rows.append(x[0])
            x, hidden = robot.step(x, np.array([[0.3, turn]]), hidden)
        runs.append(np.array(rows) + 1e-3 * rng.normal(size=(ROWS, 3)))
    assert carried(runs, {}) == []


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
