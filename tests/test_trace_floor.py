"""In one recording, what noise makes of rollouts is not told as more than what rollouts are off."""

import numpy as np

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.diagnostics.rollout_error import Held, at_most_seen, held, judge
from s2r_runtime.trace.estimation.prediction import first_steps, rms, steps_of

DT_S, ROWS, NOISE = 0.05, 900, 0.003
MODEL = compose(ModelSpec("double_integrator", DT_S))


def _recording(seed: int, *, pushed: int | None = None):
    """A body that drives as the model says; somebody leans on it for six seconds from that row on, now more, now less."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, (ROWS // 15, 2)), 15, axis=0)
    lean = np.zeros((ROWS, 2))
    if pushed is not None:
        lean[pushed : pushed + 120] = 2.0 * np.sin(np.linspace(0.0, 7.0, 120))[:, None] + 2.0 * np.repeat(
            rng.normal(size=(12, 2)), 10, axis=0
        )
    x, rows = np.zeros((1, 4)), [np.zeros(4)]
    for k in range(ROWS):
        x, _ = MODEL.step(x, (u + lean)[k : k + 1], MODEL.at_rest(1))
        rows.append(x[0])
    return from_arrays(MODEL, [(np.array(rows) + NOISE * rng.normal(size=(ROWS + 1, 4)), u)])


def _held_out(data, *, all_of_it: bool = False) -> Held:
    later = np.arange(first_steps(data)[-1]) >= (0 if all_of_it else ROWS // 2)
    return held(MODEL, data, steps_of(data).take(later), (), later, 1.0)


def test_a_floor_is_at_most_what_rollouts_are_mostly_off():
    given = _held_out(_recording(0, pushed=200))
    ends = judge(MODEL, given).ends
    loud = np.full(4, 1.0), np.full(4, 5.0)
    one, rolled = at_most_seen(loud, MODEL, given, ends)
    assert np.array_equal(one, loud[0]), "a single step's is left alone"
    assert np.all(rolled >= rms(ends))
    assert np.all(rolled < 1.0), "those that somebody leant on are a few"


def test_a_floor_is_at_most_what_all_are_off_where_that_is_more():
    given = _held_out(_recording(0, pushed=ROWS // 2 + 100))
    ends = judge(MODEL, given).ends
    loud = np.full(4, 1.0), np.full(4, 50.0)
    assert np.array_equal(at_most_seen(loud, MODEL, given, ends)[1], rms(ends))


def test_a_floor_below_what_rollouts_are_off_stays():
    given = _held_out(_recording(1))
    ends = judge(MODEL, given).ends
    quiet = np.full(4, 1.0), 0.5 * rms(ends)
    assert at_most_seen(quiet, MODEL, given, ends) is quiet


def test_where_nothing_was_fitted_in_the_recording_nothing_is_known():
    given = _held_out(_recording(1), all_of_it=True)
    loud = np.full(4, 1.0), np.full(4, 5.0)
    assert at_most_seen(loud, MODEL, given, judge(MODEL, given).ends) is loud
    assert at_most_seen(loud, MODEL, _held_out(_recording(1)), np.zeros((0, 4))) is loud
