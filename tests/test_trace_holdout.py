"""What is held out: stretches of time, or runs, on which the inputs reach as far as on what is fitted."""

import tracemalloc

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.data.split import fit_mask, part
from s2r_runtime.trace.pipeline import trace

STEPS = 1000


def _data(runs):
    model = compose(ModelSpec("joint", 0.01))
    return from_arrays(model, [(np.zeros((len(u) + 1, 2)), u[:, None]) for u in runs])


def _reach(u, seen):
    return u[seen].min(), u[~seen].min()


def test_the_usual_stretches_are_held_out_where_inputs_are_alike_throughout():
    seen = fit_mask(_data([np.random.default_rng(1).normal(size=STEPS)]), 0)
    held = np.flatnonzero(~seen) / STEPS
    assert ((held >= 0.3) & (held < 0.5) | (held >= 0.8)).all()
    assert 0.35 < np.mean(~seen) < 0.45


def test_pushes_that_only_one_side_would_see_are_shared():
    """Hard pushes at the beginning and at three quarters of the time: the usual stretches hold neither."""
    u = 0.1 * np.random.default_rng(2).normal(size=STEPS)
    u[20:60] = u[740:780] = -10.0
    fitted, held = _reach(u, fit_mask(_data([u]), 0))
    assert fitted == held == -10.0


def test_runs_are_drawn_so_that_both_sides_hold_hard_pushes():
    rng = np.random.default_rng(3)
    for seed in range(20):
        runs = [0.1 * rng.normal(size=200) for _ in range(10)]
        for run in (0, 1, 2):
            runs[run][50:90] = -10.0
        fitted, held = _reach(np.concatenate(runs), fit_mask(_data(runs), seed))
        assert fitted == held == -10.0, seed


def test_with_a_recording_of_its_own_to_judge_on_everything_is_fitted():
    assert fit_mask(_data([np.ones(STEPS)]), 0, everything=True).all()


def test_many_rows_are_looked_at_one_way_after_the_other():
    """A mask of each way, of which there are 200, would be as large as a hundred bytes a row more."""
    data = _data([np.random.default_rng(4).normal(size=100 * STEPS)])
    tracemalloc.start()
    try:
        fit_mask(data, 0)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 100 * len(data.runs[0].u)


def test_inputs_are_known_from_the_beginning_of_a_run_and_measurements_where_they_may_be_seen():
    u = np.random.default_rng(5).normal(size=STEPS)
    data = _data([u])
    seen = np.zeros(STEPS, dtype=bool)
    seen[600:700] = seen[701:800] = True  # one step between the two is held out
    kept = part(data, ((0, 650),), seen, STEPS)
    assert [run.u[:, 0].tolist() for run in kept.data.runs] == [u[:800].tolist()]
    measured = ~np.isnan(kept.data.runs[0].y).any(axis=1)
    assert np.flatnonzero(measured).tolist() == list(range(600, 801))
    assert kept.steps.place.tolist() == [k for k in range(600, 800) if k not in {650, 700}]


@pytest.mark.slow
def test_a_play_as_wide_as_its_input_goes_is_found_with_its_width():
    """Its output moves at the beginning of the drive, and hardly ever again: it never forgets where that was."""
    rng = np.random.default_rng(6)
    dt, width = 0.05, 1.1
    u = np.interp(np.arange(700), np.arange(0, 1200, 20), np.append([0.0, 0.5, 0.2, 1.2, 0.9, 1.3], rng.uniform(0.3, 0.9, 54)))
    v, x, rows = 0.0, np.zeros(3), [np.zeros(3)]
    for now in u:
        v = min(max(v, now - width / 2.0), now + width / 2.0)
        x = x + dt * np.array([v * np.cos(x[2]), v * np.sin(x[2]), 0.4])
        rows.append(x)
    model = compose(ModelSpec("unicycle", dt))
    y = np.array(rows) + rng.normal(size=(701, 3)) * 0.002
    found = trace(from_arrays(model, [(y, np.column_stack([u, np.full(700, 0.4)]))]), model)
    (play,) = [e for e in found.effects if (e.name, e.channel) == ("input_backlash", "v")]
    low, high = play.parameters["width"][1:3]
    assert low - 0.02 < width < high + 0.02


def test_the_fit_sees_the_beginning_and_the_end():
    """The hardest pushes come at the beginning and where the usual stretches are not. What changes after a quarter must be seen before."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        u = 0.1 * rng.normal(size=STEPS)
        for at in rng.choice(np.r_[0:280, 500:780], 3, replace=False):
            u[at : at + 20] = -10.0
        u[20:40] = -10.0
        seen = fit_mask(_data([u]), 0)
        fitted, held = _reach(u, seen)
        assert fitted == held == -10.0
        assert seen[:200].any()
        assert seen[800:].any()
